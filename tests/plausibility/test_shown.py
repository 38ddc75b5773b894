"""What a recording shows beside a wrong fit: each is named with its size, in a sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.table import TABLE
from tofcorr.geometry.rays import ray_directions
from tofcorr.plausibility.examine import inspect

Edit = Callable[[Parts], Parts]


def holding(share: float, to: int) -> Edit:
    """Poses that hold a share of the move to another frame."""

    def edit(parts: Parts) -> Parts:
        other = parts.poses[(np.arange(len(parts.poses)) + to).clip(0, len(parts.poses) - 1)]
        turn = Rotation.from_matrix(other[:, :3, :3] @ parts.rotation.transpose(0, 2, 1))
        turned = Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix() @ parts.rotation
        return parts.changed(
            rotation=turned, place=parts.place + share * (other[:, :3, 3] - parts.place)
        )

    return edit


def filtered(parts: Parts) -> Parts:
    before = np.concatenate([parts.depth[:1], parts.depth[:-1]])
    return parts.changed(depth=0.97 * parts.depth + 0.03 * before)


def thrice(parts: Parts) -> Parts:
    noise = 0.003 * np.random.default_rng(2).standard_normal((66, *parts.depth.shape[1:]))
    repeated = parts.frames(np.repeat(np.arange(22), 3))
    return repeated.changed(depth=repeated.depth + noise)


def scattering(parts: Parts) -> Parts:
    away = np.zeros(66)
    away[30:33] = [0.1, -0.013, 0.0]
    repeated = thrice(parts)
    return repeated.changed(depth=repeated.depth + away[:, None, None])


def capped(parts: Parts) -> Parts:
    """Single rays in whole millimetres, of which the sensor shows none above the sixth largest."""
    ray = TABLE["1 x 1 pixels"](parts, np.random.default_rng(0))
    whole = np.round(ray.depth, 3)
    return ray.changed(depth=np.minimum(whole, np.sort(whole, axis=0)[-6]))


def reflecting(parts: Parts) -> Parts:
    """A second wall adds 40 mm at one end of the first, and less by e each 0.2 m."""
    camera = parts.poses @ parts.header["tool_from_camera"]
    points = ray_directions(parts.header["camera"]).numpy() * parts.depth[..., None]
    along = np.einsum("fab,fhwb->fhwa", camera[:, :3, :3], points)[..., 0]
    along += camera[:, None, None, 0, 3]
    end = np.nanquantile(along, 0.99)
    return parts.changed(depth=parts.depth + 0.04 * np.exp(-(end - along).clip(0) / 0.2))


def drifting(parts: Parts) -> Parts:
    away = np.linspace(0, 0.018, len(parts.poses))[:, None] * parts.normal[0]
    return parts.changed(place=parts.place + away)


def of_depth(parts: Parts) -> Parts:
    return parts.changed(amplitude=np.nan_to_num(300 / parts.depth**2))


def passive(parts: Parts) -> Parts:
    assert parts.amplitude is not None
    level = np.median(parts.amplitude, axis=(1, 2), keepdims=True)
    return parts.changed(amplitude=300 * parts.amplitude / level)


@pytest.mark.parametrize(
    ("edit", "check", "words", "size"),
    [
        (holding(0.02, -1), "late", "of the move before it", (1.8, 2.2)),
        (holding(0.02, 1), "late", "of the move after it", (1.8, 2.2)),
        (filtered, "late", "of the one before it", (1.8, 3.2)),
        (drifting, "drift", "from first to last frame", (12, 22)),
        (capped, "depth values", "hold exactly the largest distance", (6, 6)),
        (scattering, "repeats", "within a pose", (105, 121)),
        (reflecting, "rim", "second reflection", (25, 55)),
        (of_depth, "amplitude", "relative noise of the depth", (-2.1, -1.9)),
        (passive, "amplitude", "falls with the distance to the power", (-0.5, 0.8)),
    ],
)
def test_what_a_recording_shows_is_named_with_its_size(
    edit: Edit, check: str, words: str, size: tuple[float, float], parts: Parts, tmp_path: Path
) -> None:
    """Each passed without a word of it, with the hand-eye transform up to 20 mm off."""
    found = inspect(edit(parts).write(tmp_path / "shown"))
    (said,) = [one.sentence for one in found.findings if one.check == check]
    assert words in said.lower()
    numbers = [word.strip("().,:%") for word in said.split()]
    sizes = [float(word) for word in numbers if word.lstrip("-").replace(".", "", 1).isdigit()]
    assert any(size[0] <= one <= size[1] for one in sizes)


def test_repeats_that_differ_by_noise_are_let_through(parts: Parts, tmp_path: Path) -> None:
    assert inspect(thrice(parts).write(tmp_path / "repeated")).headline is None
