"""What a recording shows beside a wrong fit: each is named with its size, in a sentence."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from plausibility.test_faults import drifting, without_robot
from scipy.spatial.transform import Rotation

from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.table import TABLE
from tofcorr.geometry.rays import ray_directions
from tofcorr.plausibility.examine import inspect


def before(images: np.ndarray, frames: int = 1) -> np.ndarray:
    """Return what was there so many frames before; of the first or last, itself."""
    return images[(np.arange(len(images)) - frames).clip(0, len(images) - 1)]


def holding(parts: Parts, frames: int) -> Parts:
    """Poses that hold a fiftieth of the move from so many frames before."""
    other = before(parts.poses, frames)
    turn = Rotation.from_matrix(other[:, :3, :3] @ parts.rotation.transpose(0, 2, 1)).as_rotvec()
    turned = Rotation.from_rotvec(turn / 50).as_matrix() @ parts.rotation
    return parts.changed(rotation=turned, place=parts.place + (other[:, :3, 3] - parts.place) / 50)


def filtered(parts: Parts) -> Parts:
    return parts.changed(depth=0.97 * parts.depth + 0.03 * before(parts.depth))


def thrice(parts: Parts, *, away: float = 0.0) -> Parts:
    """Every pose three times, 3 mm of noise; what is seen at one moves."""
    noise = 0.003 * np.random.default_rng(2).standard_normal((66, *parts.depth.shape[1:]))
    noise[30] += away
    return parts.frames(np.arange(66) // 3).changed(depth=np.repeat(parts.depth, 3, axis=0) + noise)


def capped(parts: Parts) -> Parts:
    """Single rays in whole millimetres, of which the sensor shows none above the sixth largest."""
    ray = TABLE["1 x 1 pixels"](parts, np.random.default_rng(0))
    whole = np.round(ray.depth, 3)
    return ray.changed(depth=np.minimum(whole, np.sort(whole, axis=0)[-6]))


def reflecting(parts: Parts) -> Parts:
    """A second wall adds 40 mm at one end of the first, and less by e each 0.2 m."""
    camera = parts.poses @ parts.header["tool_from_camera"]
    points = ray_directions(parts.header["camera"]).numpy() * parts.depth[..., None]
    along = (camera[:, None, None, 0, :3] * points).sum(-1) + camera[:, None, None, 0, 3]
    end = np.nanquantile(along, 0.99)
    return parts.changed(depth=parts.depth + 0.04 * np.exp(-(end - along).clip(0) / 0.2))


def passive(parts: Parts) -> Parts:
    seen = np.asarray(parts.amplitude)
    return parts.changed(amplitude=300 * seen / np.median(seen, axis=(1, 2), keepdims=True))


# What is said, the edit, and between which numbers that of the sentence lies.
SHOWN: dict[str, tuple[Callable[[Parts], Parts], float, float]] = {
    "of the move before it": (lambda p: holding(p, 1), 1.8, 2.2),
    "of the move after it": (lambda p: holding(p, -1), 1.8, 2.2),
    "of the one before it": (filtered, 1.8, 3.2),
    "From first to last": (lambda p: drifting(p, 0.018), 12, 22),
    "exactly the largest": (capped, 6, 6),
    "within a pose": (lambda p: thrice(p, away=0.113), 105, 121),
    "second reflection": (reflecting, 25, 55),
    "noise of the depth": (lambda p: p.changed(amplitude=9 / p.depth**2), -2.1, -1.9),
    "times the relative noise": (lambda p: p.changed(amplitude=9 / p.depth), -1.1, -0.9),
    "light with that of 2": (passive, -0.5, 0.8),
}


@pytest.mark.parametrize("words", SHOWN)
def test_what_a_recording_shows_is_named_with_its_size(
    words: str, parts: Parts, tmp_path: Path
) -> None:
    """Each passed without a word of it, with the hand-eye transform up to 20 mm off."""
    edit, low, high = SHOWN[words]
    found = inspect(edit(parts).write(tmp_path / "shown")).findings
    (said,) = [one.sentence for one in found if words in one.sentence]
    assert any(low <= float(number) <= high for number in re.findall(r"-?\d+\.?\d*", said))


def test_repeats_that_differ_by_noise_are_let_through(parts: Parts, tmp_path: Path) -> None:
    assert inspect(thrice(parts).write(tmp_path / "repeated")).headline is None


@pytest.mark.parametrize("words", ["of the one before it", "From first to last"])
def test_a_camera_on_a_tripod_that_filters_or_drifts_is_named_without_a_robot(
    words: str, parts: Parts, tmp_path: Path
) -> None:
    """Both passed without a word where no robot moves the camera."""
    still = without_robot(parts, inspect(parts.write(tmp_path / "moved")).look.given.hand_eye)
    away = np.linspace(0, 0.06, len(still.depth))[:, None, None]
    changed = filtered(still) if "before" in words else still.changed(depth=still.depth + away)
    found = inspect(changed.write(tmp_path / "shown"))
    assert words in str(found.headline)
    assert "robot" not in repr(found)
    assert "pose" not in str(found.headline)
