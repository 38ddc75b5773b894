"""The oracle finds what was put in, and its base model is the generator's own."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.withheld import cases
from benchmarks.withheld.fitting import linearise
from benchmarks.withheld.generator.catalogue import draw_effect
from benchmarks.withheld.generator.noise import Noise
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.recording import record
from benchmarks.withheld.generator.rigid import inverse
from benchmarks.withheld.generator.world import draw_setup, draw_world
from benchmarks.withheld.generator.writing import write_recording
from benchmarks.withheld.oracle import Oracle, ask
from benchmarks.withheld.reading import Data, read


def recorded(
    folder: Path, effects: dict[str, float], kind: Noise | None = None
) -> tuple[Data, dict, np.ndarray]:
    rng = np.random.default_rng(4)
    setup = draw_setup(rng)
    world = draw_world(rng, setup, Design(frames=40))
    wanted = [(draw_effect(name, rng), size * 1e-3) for name, size in effects.items()]
    made, truth = record(rng, world, wanted, kind or Noise())
    write_recording(folder, made)
    return read(folder), dict(truth.fields), truth.expected


def test_base_model_leaves_hundredths_of_a_millimetre_of_the_smooth_base(tmp_path: Path) -> None:
    data, fields, expected = recorded(tmp_path / "r", {}, Noise(pose_scale=0.0))
    oracle = ask(replace(data, depth=np.where(data.valid, expected, np.nan)), fields, expected)
    assert oracle.plain.before_mm < 0.06


def test_hand_eye_of_the_fit_is_the_true_one(tmp_path: Path) -> None:
    list(cases.generate(3, {"C": 1}, tmp_path))
    (entry,) = json.loads((tmp_path / "manifest.json").read_text())["recordings"]
    answer = json.loads((tmp_path / "answers" / entry["id"] / "answer.json").read_text())
    found = linearise(read(tmp_path / "recordings" / entry["id"])).tool_from_camera
    miss = inverse(np.array(answer["tool_from_camera"])) @ found
    assert np.linalg.norm(miss[:3, 3]) < 2e-3
    assert np.abs(miss[:3, :3] - np.eye(3)).max() < 2e-3


def test_oracle_closes_a_gap_of_known_size(tmp_path: Path) -> None:
    # A pattern of random signs is nothing to the base: the gap is the pattern.
    data, _, expected = recorded(tmp_path / "r", {}, Noise(pose_scale=0.0))
    pattern = 4e-3 * np.random.default_rng(0).choice([-1.0, 1.0], data.depth.shape[1:])
    field = np.broadcast_to(pattern, data.depth.shape)
    oracle = ask(replace(data, depth=data.depth + field), {"pattern": field}, expected + field)
    assert oracle.plain.before_mm == pytest.approx(4.0, abs=0.15)
    assert oracle.plain.after_mm < 0.4
    assert oracle.plain.closes_mm["pattern"] == pytest.approx(oracle.plain.shrinkage_mm)
    assert oracle.left["pattern"] == pytest.approx(1.0, abs=0.02)
    assert oracle.must_find("pattern")


def test_an_effect_that_calibration_absorbs_need_not_be_found(tmp_path: Path) -> None:
    data, _, expected = recorded(tmp_path / "r", {})
    field = np.full(data.depth.shape, 5e-3)
    oracle = ask(replace(data, depth=data.depth + field), {"offset": field}, expected + field)
    assert oracle.left["offset"] < 1e-8
    assert not oracle.must_find("offset")
    assert oracle.plain.shrinkage_mm == pytest.approx(0.0, abs=1e-3)


def test_an_effect_that_is_not_there_is_not_found(tmp_path: Path) -> None:
    data, _, expected = recorded(tmp_path / "r", {})
    rng = np.random.default_rng(0)
    columns = {
        f"c{k}": rng.normal(0, 1e-3, (40, 1, 1)) + np.zeros(data.depth.shape) for k in range(8)
    }
    oracle = ask(data, columns, expected)
    assert sum(map(oracle.must_find, columns)) <= 1


def test_each_of_two_effects_closes_its_own_part(tmp_path: Path) -> None:
    data, fields, expected = recorded(
        tmp_path / "r", {"fixed_pattern": 4.0, "room_temperature": 5.0}
    )
    oracle: Oracle = ask(data, fields, expected)
    assert all(map(oracle.must_find, fields))
    assert oracle.plain.after_mm < 1.0
    assert all(closes > 1.0 for closes in oracle.plain.closes_mm.values())


def test_evidence_is_half_the_fitted_strength_over_its_error(tmp_path: Path) -> None:
    # Halving an effect halves its t, and so its evidence.
    data, _, expected = recorded(tmp_path / "r", {})
    pattern = 2e-3 * np.random.default_rng(0).normal(size=data.depth.shape[1:])
    field = np.broadcast_to(pattern, data.depth.shape)
    whole, half = (
        ask(replace(data, depth=data.depth + part), {"p": part}, expected + part).evidence["p"]
        for part in (field, field / 2)
    )
    assert whole == pytest.approx(2 * half, rel=0.15)
