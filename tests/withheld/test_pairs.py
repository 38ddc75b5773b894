"""Laws of the pairs: right geometry, right truth."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from withheld.small_pairs import SMALL, a_pair

from benchmarks.withheld.generator.pair_cases import KINDS, PairCase, draw_pair
from benchmarks.withheld.generator.pair_truth import centred_parts, shares
from benchmarks.withheld.generator.pairs import Pair, record_pair
from benchmarks.withheld.generator.recording import Recorded
from benchmarks.withheld.pairs import cases, commands, renderer

TERMS = ("distance", "pixel", "amplitude")


def geometry(one: Recorded) -> np.ndarray:
    """Radial distance (N, H, W) that the stated poses, hand-eye and plane of a recording imply."""
    setup = one.world.setup
    camera = one.stated_poses @ setup.tool_from_camera_guess
    normal, point = setup.world_from_target[:3, 2], setup.world_from_target[:3, 3]
    toward = np.einsum("nij,hwj->nhwi", camera[:, :3, :3], setup.camera.rays()) @ normal
    return ((point - camera[:, :3, 3]) @ normal)[:, None, None] / toward


@pytest.mark.parametrize("more", [{}, {"hand_eye_off": True}, {"other_poses": True}])
def test_what_an_ideal_simulator_states_explains_its_frames_exactly(more: dict[str, Any]) -> None:
    simulated = a_pair(**more).simulated
    error = (simulated.depth - geometry(simulated))[simulated.mask]
    assert np.nanmax(np.abs(error)) < 1e-9


def test_gap_as_given_is_what_the_two_recordings_show_beside_noise(ideal: Pair) -> None:
    difference = (ideal.real.depth - ideal.simulated.depth)[ideal.real.mask & ideal.simulated.mask]
    square = np.nanmean((1e3 * difference) ** 2) - ideal.truth["real_noise_mm"] ** 2
    # Poses of the robot differ by 0.3 mm and 0.3 mrad: less than 1 mm, in quadrature.
    assert np.sqrt(square) == pytest.approx(ideal.truth["as_given_mm"], rel=0.02)


def test_shares_sum_to_one_and_an_exact_hand_eye_has_none(ideal: Pair) -> None:
    for told in ("shares", "own_constant_shares"):
        assert sum(ideal.truth[told].values()) == pytest.approx(1.0)
        assert ideal.truth[told]["hand_eye"] == pytest.approx(0.0, abs=1e-9)
    assert ideal.truth["parts_mm"]["row_column_pattern"] == pytest.approx(5.0, rel=0.02)


def test_a_wrong_hand_eye_has_a_share() -> None:
    truth = a_pair(hand_eye_off=True).truth
    assert truth["parts_mm"]["hand_eye"] > 1.0
    assert abs(truth["shares"]["hand_eye"]) > 0.01


def test_shares_by_hand() -> None:
    # Sum (3, 4): its square is 25; the parts' inner products with it are 9 + 8 and 8.
    parts = {"one": np.array([3.0, 2.0]), "other": np.array([0.0, 2.0])}
    assert shares(parts) == {"one": pytest.approx(17 / 25), "other": pytest.approx(8 / 25)}


def test_every_constant_counts_as_distance() -> None:
    parts = {"distance": np.array([1.0, 3.0]), "lens": np.array([4.0, 8.0])}
    centred = centred_parts(parts)
    assert centred["lens"].tolist() == [-2.0, 2.0]
    assert centred["distance"].tolist() == [-1.0 + 8.0, 1.0 + 8.0]


def test_pixels_that_an_effect_moves_off_the_target_are_no_part_of_the_truth() -> None:
    pair = a_pair(withheld=(("lens", 5.0),))
    assert pair.truth["parts_mm"]["lens"] == pytest.approx(5.0, rel=0.05)


def test_shares_are_the_shapley_values_of_the_square_that_correcting_causes_removes() -> None:
    rng = np.random.default_rng(0)
    parts = {name: rng.normal(size=9) for name in "abc"}
    total = sum(parts.values(), np.zeros(9))

    def removed(names: str) -> float:
        left = total - sum((parts[name] for name in names), np.zeros(9))
        return float(total @ total - left @ left)

    orders = ["abc", "acb", "bac", "bca", "cab", "cba"]
    for name in parts:
        before = [order[: order.index(name)] for order in orders]
        value = np.mean([removed(names + name) - removed(names) for names in before])
        assert shares(parts)[name] == pytest.approx(value / (total @ total))


def test_a_simulator_that_shares_everything_leaves_no_gap() -> None:
    truth = a_pair(shared=(("wiggling", 4.0),), terms=TERMS, noise=1.0).truth
    assert truth["as_given_mm"] < 1e-6
    assert truth["shares"] == {}


def test_a_shared_effect_is_no_part_of_the_gap() -> None:
    truth = a_pair(
        withheld=(("fixed_pattern", 3.0),), shared=(("wiggling", 6.0),), terms=TERMS, noise=1.0
    ).truth
    assert truth["as_given_mm"] == pytest.approx(3.0, rel=0.03)
    assert truth["shares"]["fixed_pattern"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dark", [False, True])
def test_noise_dropouts_and_amplitude_are_as_the_truth_says(dark: bool) -> None:
    case = PairCase("noise", terms=TERMS, design=replace(SMALL, frames=24))
    case = replace(case, noise=0.5, dropouts=(0.04, 0.0), amplitude_gain=1.2, dark_dropouts=dark)
    pair = record_pair(np.random.default_rng(1), case)
    real, simulated = pair.real, pair.simulated
    both = real.mask & simulated.mask
    ratio = np.nanmedian(real.amplitude[both] / simulated.amplitude[both])
    assert ratio == pytest.approx(pair.truth["amplitude_ratio"], rel=0.01)
    missing = np.isnan(real.depth[real.mask]).mean()
    assert missing == pytest.approx(pair.truth["real_dropouts"], abs=0.003)
    noise = [
        np.nanstd((one.depth - geometry_with_errors(one, pair))[both]) for one in (real, simulated)
    ]
    assert noise[0] / noise[1] == pytest.approx(pair.truth["noise_ratio"], rel=0.03)
    gone = real.mask & np.isnan(real.depth)
    brightness = np.median(real.amplitude[gone]) / np.median(real.amplitude[real.mask])
    assert (brightness < 0.8) == dark


def geometry_with_errors(one: Recorded, pair: Pair) -> np.ndarray:
    """Expected distances of the camera; the simulator that shares all expects the same."""
    assert one.depth.shape == pair.expected.shape
    return pair.expected


def test_held_out_frames_are_ideal_and_stand_at_poses_of_their_own(ideal: Pair) -> None:
    assert ideal.held_out is not None
    frames = ideal.held_out.ideal
    assert np.abs(frames.depth - geometry(frames))[frames.mask].max() < 1e-9
    gaps = frames.stated_poses[:, None, :3, 3] - ideal.real.stated_poses[None, :, :3, 3]
    assert np.linalg.norm(gaps, axis=-1).min() > 1e-3
    seen = np.isfinite(ideal.held_out.expected)
    assert (seen <= frames.mask).all()
    size = np.sqrt(np.mean((ideal.held_out.expected - frames.depth)[seen] ** 2))
    assert 1e3 * size == pytest.approx(ideal.truth["as_given_mm"], rel=0.5)


@pytest.mark.skipif(bool(renderer.missing()), reason=renderer.missing())
def test_the_renderer_and_geometry_agree_to_a_hundredth_of_a_millimetre() -> None:
    pair = a_pair(renderer="pybullet")
    drawn = renderer.rendered(pair.simulated)
    error = (drawn.depth - geometry(drawn))[drawn.mask]
    assert np.abs(error).max() < 1e-5


@pytest.mark.parametrize("kind", ["other", "noise"])
def test_pairs_are_valid_recordings_and_repeatable(kind: str, tmp_path: Path) -> None:
    recording = pytest.importorskip("tofcorr.data.recording")
    entries = [cases.write_pair(6, kind, 0, tmp_path / name) for name in ("one", "two")]
    assert entries[0] == entries[1]
    for part in ("id", "sim"):
        opened = recording.Recording.open(tmp_path / "one" / "recordings" / entries[0][part])
        assert opened.moves


def test_the_simulator_is_rendered_where_the_robot_says(tmp_path: Path) -> None:
    entry = cases.write_pair(6, "hand_eye", 4, tmp_path)
    rows = []
    for part in ("id", "sim"):
        with (tmp_path / "recordings" / entry[part] / "frames.csv").open() as file:
            rows.append(list(csv.DictReader(file)))
    for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw", "nx", "ny", "nz", "d"):
        assert [row[name] for row in rows[0]] == [row[name] for row in rows[1]]
    assert not (tmp_path / "recordings" / entry["sim"] / "amplitude.npy").exists()
    assert "integration_time_us" not in rows[1][0]


def test_every_kind_can_be_drawn_and_asked_for() -> None:
    assert commands.counts_of(",".join(commands.KINDS), 1) == dict.fromkeys(KINDS, 1)
    drawn = [draw_pair(kind, i, np.random.default_rng(i)) for kind in KINDS for i in range(8)]
    assert {one.tier for one in drawn} == set(KINDS)
    assert all(
        one.withheld or one.tier in {"no_effect", "nothing", "other_nothing", "noise"}
        for one in drawn
    )


def test_an_unknown_kind_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="no kind of pair 'none': expected some of ideal, no_eff"):
        draw_pair("none", 0, np.random.default_rng(0))
