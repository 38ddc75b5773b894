"""Pairs of a camera and a simulator: what is true of them, and how answers are judged."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optional import present

import tofcorr
from benchmarks.renewed import ranges
from benchmarks.renewed.recording import Data, read
from benchmarks.sealed.answers import Outcome, Said
from benchmarks.sealed.oracle import Oracle
from benchmarks.withheld.pairs import (
    DEGRADED_NEAR,
    KINDS,
    TARGETS,
    gap_of,
    judge,
    oracle_error,
    shares_covered,
    within,
    write_pair,
)
from tofcorr.data.recording import Recording


def a_pair(out: Path, kind: str, index: int = 0, seed: int = 4) -> tuple[dict, Data, Data, Path]:
    """Answer, camera, simulator, and the folder of the answer."""
    entry = write_pair(seed, kind, index, out)
    answers = out / "answers" / entry["id"]
    answer = json.loads((answers / "answer.json").read_text())
    sides = [read(out / "recordings" / entry[side]) for side in ("id", "sim")]
    return answer | entry, sides[0], sides[1], answers


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_are_valid_recordings_and_repeatable(kind: str, tmp_path: Path) -> None:
    entry = write_pair(3, kind, 1, tmp_path / "a")
    assert write_pair(3, kind, 1, tmp_path / "b") == entry
    for part in {"id", "sim", "held_out"} & entry.keys():
        Recording.open(tmp_path / "a" / "recordings" / entry[part])


def test_what_an_ideal_simulator_states_explains_its_frames_exactly(tmp_path: Path) -> None:
    _, _, sim, _ = a_pair(tmp_path, "ideal")
    camera = sim.world_from_tool @ sim.tool_from_camera
    toward = np.einsum("nij,hwj->nhwi", camera[:, :3, :3], sim.rays)
    height = (sim.normal * camera[:, :3, 3]).sum(-1) + sim.offset
    distance = -height[:, None, None] / np.einsum("ni,nhwi->nhw", sim.normal, toward)
    assert sim.amplitude is None
    assert np.abs(sim.depth - distance)[sim.valid].max() < 2e-6


def test_the_gap_as_given_is_what_both_recordings_show_beside_noise(tmp_path: Path) -> None:
    answer, camera, sim, folder = a_pair(tmp_path, "ideal")
    truth = answer["truth"]
    expected, both = np.load(folder / "expected.npy"), camera.valid & sim.valid
    shown = 1e3 * np.sqrt(np.mean((expected - sim.depth)[both] ** 2))
    assert shown == pytest.approx(truth["as_given_mm"], rel=0.1)  # the robot's 0.3 mm and mrad
    assert sum(truth["shares"].values()) == pytest.approx(1.0)


def test_a_simulator_that_shares_everything_leaves_no_gap(tmp_path: Path) -> None:
    for index in (0, 1):
        answer, *_ = a_pair(tmp_path / str(index), "nothing", index)
        assert answer["truth"]["as_given_mm"] < 1e-6
        assert answer["truth"]["shares"] == {}


def test_a_shared_effect_is_no_part_of_the_gap(tmp_path: Path) -> None:
    answer, *_ = a_pair(tmp_path, "shared")
    (withheld,) = answer["sizes_mm"]
    assert answer["case"]["shared"] != [withheld]
    shares = answer["truth"]["shares"]  # the effect's own constant counts as distance
    assert shares[withheld] + shares["distance"] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("index", [1, 4])
def test_noise_dropouts_and_amplitude_are_as_the_truth_says(index: int, tmp_path: Path) -> None:
    answer, camera, sim, folder = a_pair(tmp_path, "noise", index)
    truth, expected = answer["truth"], np.load(folder / "expected.npy")
    names = {"real": ("id", camera), "sim": ("sim", sim)}
    for who, (part, side) in names.items():
        mask = np.load(tmp_path / "recordings" / answer[part] / "mask.npy") > 0
        missing = np.mean(~np.isfinite(side.depth[mask]))
        assert missing == pytest.approx(truth[f"{who}_dropouts"], abs=0.01)
    both = camera.valid & sim.valid
    ratio = np.median(present(camera.amplitude)[both] / present(sim.amplitude)[both])
    assert ratio == pytest.approx(truth["amplitude_ratio"], rel=0.02)
    noise = [np.std((one.depth - expected)[both]) for one in (camera, sim)]
    assert noise[0] / noise[1] == pytest.approx(truth["noise_ratio"], rel=0.1)


def test_held_out_frames_are_ideal_and_an_oracle_leaves_little_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ranges.PLAIN, "frames", {60: 1.0})
    answer, camera, _, folder = a_pair(tmp_path, "ideal")
    held = read(tmp_path / "recordings" / answer["held_out"])
    true, sigma = np.load(folder / "held_out.npy"), np.load(folder / "held_out_sigma.npy")
    (effect,) = answer["sizes_mm"]
    fields = [tuple(np.load(folder / f"{a}field_{effect}.npy") for a in ("", "held_out_"))]
    met = np.where(held.valid, true, np.nan)
    ideal = Data(**{**vars(held), "depth": met, "valid": np.isfinite(met)})
    station = held.columns["pose_id"]
    with_effect = gap_of(oracle_error(camera, ideal, fields), sigma, station)[0]
    without = gap_of(oracle_error(camera, ideal, []), sigma, station)[0]
    assert with_effect < without
    assert np.nanmax(np.abs(met - held.depth)) > 1e-3


def test_a_gap_is_weighted_by_the_noise_and_leaves_gross_errors_out() -> None:
    error = np.array([[[1e-3, 2e-3, 1.0]], [[1e-3, 2e-3, np.nan]]])
    sigma = np.array([[[1e-4, 5e-3, 1e-3]]] * 2)
    gap, _ = gap_of(error, sigma, np.array([0, 1]))
    weights = 1 / (1 + (sigma[0, 0, :2] / 5e-3) ** 2)
    square = (weights * np.array([0.0, 4.0])).sum() / weights[1]
    assert gap == pytest.approx(math.sqrt(square))  # 1 mm is ten of its standard deviations


def test_what_no_pixel_of_a_recording_was_like_does_not_count(tmp_path: Path) -> None:
    _, camera, _, _ = a_pair(tmp_path, "terms")
    farther = Data(**{**vars(camera), "depth": camera.depth + 100.0})
    assert within(camera, camera)[camera.valid].all()
    assert not within(farther, camera).any()


def outcome(sets: list[list[str]], shared: tuple[str, ...] = (), **more: Any) -> Outcome:
    effects = [members[0] for members in sets]
    stages = [
        {"name": "as_given", "gap_mm": 10.2, "ci": [9.0, 11.0]},
        {"name": "with_effects", "gap_mm": 1.0, "ci": [0.9, 1.1]},
    ]
    named = {"cause": [*effects, "lens"][0], "share": 0.6, "ci": [0.5, 0.7], "kind": "effect"}
    distance = {"cause": "distance", "share": 0.4, "ci": [0.3, 0.45], "kind": "parameter"}
    report = {"stages": stages, "attribution": [distance, named], "verdict": "Differ by 10.3 mm."}
    truth = {"as_given_mm": 10.0, "shares": {"distance": 0.42, "lens": 0.58}}
    case = {"tier": "ideal", "shared": list(shared)}
    answer = {"case": case, "sizes_mm": {"lens": 5.0}, "truth": truth}
    said = Said(tuple(effects), tuple(map(frozenset, sets)), report=report | more)
    return Outcome("r", answer, Oracle(5.0, 1.0, {"lens": 9.0}), said)


def test_size_share_and_cause_by_hand() -> None:
    one = outcome([["target_shape", "lens"]])
    held = judge(one)
    assert held["gap as given within 5 %"]
    assert held["first number of the verdict within 5 %"]
    assert held["every share within 0.05"]
    assert shares_covered(one) == [True, True]
    assert held["effect in its set"]
    assert not held["something else named"]
    held = judge(outcome([["warm_up"]], ("warm_up",)))
    assert held["something else named"]
    assert held["every share within 0.05"] is False
    assert held["an effect named that both have"]
    both = judge(outcome([["warm_up", "lens"]], ("warm_up",)))
    assert not both["an effect named that both have"]


def test_a_report_without_stages_and_blocks_is_not_measured() -> None:
    one = outcome([["lens"]], stages=None, attribution=None, verdict="")
    held = judge(one, NEAR)
    for what in (*list(TARGETS)[:3], DEGRADED_NEAR):
        assert held.get(what) is None
    noise = {"real_mm": 4.1, "sim_mm": 2.0}
    dropouts = {"real_share": 0.011, "sim_share": 0.0}
    one = outcome([], noise=noise, dropouts=dropouts, amplitude={"ratio": 1.2})
    blocks = {"noise_ratio": 2.0, "real_dropouts": 0.01, "sim_dropouts": 0.0}
    one.answer["truth"] = {"shares": {}, "amplitude_ratio": 1.0, **blocks}
    assert [*judge(one).values()] == [False, False, False, True, True, False]


# Gaps, an error of a square, noise and missing pixels of degraded frames, see `read_degraded`.
NEAR: dict[str, float] = {
    "gap_mm": 1.05,
    "error_of_square": 0.1,
    "own_mm": 1.0,
    "oracle_mm": 0.9,
    "noise_mm": 4.2,
    "true_noise_mm": 4.0,
    "missing": 0.01,
    "true_missing": 0.011,
}


def test_degraded_frames_are_held_against_the_last_stage() -> None:
    far = NEAR | {"gap_mm": 3.0, "noise_mm": 6.0, "missing": 0.05, "true_missing": 0.01}
    plain = judge(outcome([["lens"]]))
    one, other = (judge(outcome([["lens"]]), found) for found in (NEAR, far))
    for what in one.keys() - plain.keys():
        assert one[what], what
        assert other[what] is ("oracle" in what), what


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 21])
def test_the_verdict_says_the_gap_of_the_simulator_as_given(seed: int, tmp_path: Path) -> None:
    answer, *_ = a_pair(tmp_path, "ideal", seed=seed)
    folder, options = tmp_path / "recordings", {"simulate_anew": False, "page": False}
    found = tofcorr.diagnose(folder / answer["id"], folder / answer["sim"], options)
    effects = dict.fromkeys(answer["sizes_mm"], 9.0)
    said = Said(report={"verdict": found.verdict})
    held = judge(Outcome("r", answer, Oracle(5.0, 1.0, effects), said))
    assert held["first number of the verdict within 5 %"]
