"""A mask of single images is computed once for each frame, and stays what it is."""

from pathlib import Path

import pytest
import torch
from small_recordings import CAMERA, write_small_recording
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import with_exclusion
from tofcorr.pixels.ransac import NotOnLargestPlane
from tofcorr.pixels.remembered import Remembered


class _Counted:
    """A mask that notes the frames it looks at."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self._mask = NotOnLargestPlane(ray_directions(CAMERA), 0.3)

    def __call__(self, batch: FrameBatch) -> Tensor:
        self.seen += batch.indices.tolist()
        return self._mask(batch)


@pytest.fixture
def two(tmp_path: Path) -> Dataset:
    paths = [write_small_recording(tmp_path / f"{seed}", seed=seed) for seed in (1, 2)]
    return Dataset(tuple(Recording.open(path) for path in paths))


def _valid(dataset: Dataset, chunk_pixels: int = 10**6) -> Tensor:
    return torch.cat([one.valid for one in dataset.batches(chunk_pixels=chunk_pixels)])


def test_every_frame_is_looked_at_once(two: Dataset) -> None:
    """A robust fit looked at each image 32 times: it took ten times as long as another fit."""
    counted = _Counted()
    dataset = with_exclusion(two, Remembered(counted))
    first = _valid(dataset)
    assert counted.seen == list(range(two.num_frames))
    for chunk_pixels in (1, CAMERA.width * CAMERA.height * 2, 10**6):
        assert torch.equal(_valid(dataset, chunk_pixels), first)
    assert counted.seen == list(range(two.num_frames))
    assert torch.equal(first, _valid(with_exclusion(two, _Counted())))
    assert bool(first.any())
    assert not torch.equal(first, _valid(two))


def test_what_does_not_fit_into_the_memory_is_computed_anew(
    two: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofcorr.pixels.remembered._MOST_BYTES", 0)
    counted = _Counted()
    dataset = with_exclusion(two, Remembered(counted))
    assert torch.equal(_valid(dataset), _valid(dataset))
    assert counted.seen == 2 * list(range(two.num_frames))
