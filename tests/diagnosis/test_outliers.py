"""What is said of pixels that the fit leaves out, and where no amplitude was recorded."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diagnosed_recordings import altered, recorded, simulator, true_inputs

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import Prepared, prepare
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.findings.outliers import Outliers, mask_warning
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base import unknown_amplitude_columns
from tofcorr.diagnosis.sums.observations import observe

SMALL = DiagnosisOptions(catalogue=("wiggling", "lens"))
FEW = {"shots": [{"target": "white", "poses": 15}, {"target": "checkerboard", "poses": 15}]}
REPEATED = FEW | {"robot": {"repeat_poses": 3, "repeat_frames": 4}}


def _prepared(
    folder: Path, odd: np.ndarray, off: float, changes: Mapping[str, Any] = FEW
) -> Prepared:
    """A recording with nothing missing but pixels `odd` (N, H, W) that are off, metres."""
    recording = recorded(folder, 45, [], changes)
    return prepare(altered(recording, lambda z: z + off * odd), SMALL)


@pytest.fixture(scope="module")
def scattered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Prepared, np.ndarray]:
    odd = np.random.default_rng(1).uniform(size=(30, 24, 32)) < 0.03
    return _prepared(tmp_path_factory.mktemp("scattered") / "recording", odd, 0.7), odd


def test_the_share_and_size_of_deleted_pixels_are_those_that_were_put_in(
    scattered: tuple[Prepared, np.ndarray],
) -> None:
    prepared, odd = scattered
    outliers = prepared.outliers
    used = np.zeros(odd.shape, dtype=bool)
    seen = prepared.study.observations
    used.reshape(len(odd), -1)[seen.frame.numpy(), seen.pixel.numpy()] = True
    assert outliers.deleted == pytest.approx(odd[used].mean(), rel=0.02)
    assert outliers.size == pytest.approx(0.7, rel=0.02)


@pytest.mark.parametrize("changes", [FEW, REPEATED], ids=["single frames", "repeats"])
def test_gross_errors_of_pixels_are_no_noise(changes: Mapping[str, Any], tmp_path: Path) -> None:
    """Three in a hundred pixels once tripled the noise, and hid how far the poses scatter."""
    frames = 30 if changes is FEW else 39
    odd = np.random.default_rng(3).uniform(size=(frames, 24, 32)) < 0.03
    spoilt = _prepared(tmp_path / "spoilt", odd, 0.7, changes).study
    clean = _prepared(tmp_path / "clean", odd, 0.0, changes).study
    assert spoilt.fit.noise.repeats == clean.fit.noise.repeats
    assert spoilt.fit.floor == pytest.approx(clean.fit.floor, rel=0.05)
    limits = [one.fit.noise.limits(one.fit.shared.level) for one in (spoilt, clean)]
    most = [most / likeliest for _, likeliest, most in limits]
    assert most[0] == pytest.approx(most[1], rel=0.05)


def test_many_outliers_are_warned_of_by_their_place(scattered: tuple[Prepared, np.ndarray]) -> None:
    warning = scattered[0].warnings[-1]
    assert "mm RMS and are left out as outliers" in warning
    assert "They lie all over the images." in warning


def test_outliers_in_one_corner_are_said_to_be_there(tmp_path: Path) -> None:
    odd = np.zeros((30, 24, 32), dtype=bool)
    odd[:, :4, :6] = np.random.default_rng(2).uniform(size=(30, 4, 6)) < 0.3
    place = _prepared(tmp_path / "corner", odd, 0.7).outliers.place
    assert place.startswith("mostly in rows 0 to 3 and columns 0 to ")


@pytest.mark.parametrize(
    ("deleted", "reduced", "size", "noise", "said"),
    [
        (0.004, 0.005, 0.02, 0.005, ""),
        (0.004, 0.007, 0.02, 0.005, "0.7 % count less, as outliers"),
        # 0.9 % of flying pixels, 75 mm off: 7 mm RMS that the gap does not hold.
        (0.009, 0.0, 0.075, 0.005, "are off by 75 mm RMS"),
        (0.009, 0.0, 0.075, 0.008, ""),
    ],
)
def test_few_outliers_are_a_warning_only_where_they_outweigh_the_noise(
    deleted: float, reduced: float, size: float, noise: float, said: str
) -> None:
    shares = {"deleted": deleted, "reduced": reduced, "size": size, "noise": noise}
    warning = Outliers(**shares, place="nowhere").warning
    assert said in warning
    assert bool(warning) == bool(said)


def test_an_error_by_an_amplitude_that_was_not_recorded_is_no_other_effect(tmp_path: Path) -> None:
    delays = {"amplitude": {"scale_mm": 2.0}}
    strong = {"shots": [{"target": "white", "poses": 40}], "sensor": {"delays": delays}}
    recording = recorded(tmp_path / "dark", 46, [], strong)
    (recording.path / "amplitude.npy").unlink()
    prepared = prepare(Recording.open(recording.path), DiagnosisOptions())
    assert "amplitude cannot be named" in prepared.warnings[0]
    assert name_effects(prepared.study).names == ()


def test_the_columns_for_an_unknown_amplitude_hold_that_of_a_uniform_target(tmp_path: Path) -> None:
    white = {
        "shots": [{"target": "white", "poses": 10}],
        "sensor": {"light": {"vignetting_exponent": 2.0}},
        "conditions": {"ambient_counts": [0.0, 0.0]},
    }
    recording = recorded(tmp_path / "white", 47, [], white, noise=False)
    inputs = true_inputs(recording, simulator(47, [], white))
    amplitude = inputs.known_amplitude
    blind = replace(inputs, amplitude=None, amplitude_images=None)
    columns = unknown_amplitude_columns(observe(recording, 10_000_000), blind)
    fitted = columns @ torch.linalg.lstsq(columns, amplitude[:, None]).solution
    left = (amplitude - fitted[:, 0]).square().mean().sqrt() / amplitude.std()
    assert float(left) < 0.03


def _masked(recording: Recording, kept: np.ndarray) -> str:
    """Return the warning of a recording whose mask keeps these pixels, (N, H, W)."""
    np.save(recording.path / "mask.npy", kept.astype(np.uint8))
    return mask_warning(observe(Recording.open(recording.path), 50_000))


def test_a_mask_that_leaves_few_pixels_is_warned_of(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "masked", 60, noise=False)
    shape = np.load(recording.path / "depth.npy").shape
    random = np.random.default_rng(60)
    assert not mask_warning(observe(recording, 50_000))
    assert not _masked(recording, np.ones(shape))
    # Beside one of fifty poses, half of another shows a pixel, and then two and a half.
    assert "in one pose alone" in _masked(recording, random.uniform(size=shape) < 0.01)
    assert not _masked(recording, random.uniform(size=shape) < 0.05)
    same = random.uniform(size=shape[1:]) < 0.01
    found = _masked(recording, np.broadcast_to(same, shape))
    assert found.startswith(f"The mask leaves {100 * same.mean():.1f} %")
    assert "alone" not in found


def test_pixels_one_unambiguous_range_off_are_called_wrapped(tmp_path: Path) -> None:
    """20 MHz repeats after 7.49 m; errors of another size are no wrapping."""
    odd = np.random.default_rng(1).uniform(size=(30, 24, 32)) < 0.02
    wrapped = _prepared(tmp_path / "wrapped", odd, 299_792_458.0 / 40e6).outliers.warning
    assert "most by 7.49 m or a multiple of it, the unambiguous range" in wrapped
    assert "unambiguous" not in _prepared(tmp_path / "other", odd, 5.0).outliers.warning
