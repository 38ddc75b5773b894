"""A target beyond the unambiguous range is measured one range nearer, and that is said."""

from dataclasses import replace

import diagnosed_recordings
import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import SPEED_OF_LIGHT, unambiguous_range, wrapped
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("wrapping") / "recording"
    changes = {"shots": [{"target": "white", "poses": 40}]}
    return diagnosed_recordings.recorded(folder, 73, changes=changes)


def _sentences(recording: Recording, share_beyond: float) -> dict[str, str]:
    """What is said of a camera whose range ends below this share of the distances."""
    depth = np.asarray(recording.depth)
    size = float(np.nanquantile(depth, 1 - share_beyond))
    changed = replace(
        recording,
        depth=np.mod(depth, size).astype(np.float32),
        modulation_frequency=SPEED_OF_LIGHT / (2 * size),
    )
    found = examine(Dataset((changed,)))
    return {f"{one.severity} {one.check}": one.sentence for one in found.findings}


def test_few_wrapped_pixels_are_garbage_whose_cause_is_known(recording: Recording) -> None:
    said = _sentences(recording, 0.02)
    garbage = [text for name, text in said.items() if name.endswith("garbage")]
    assert len(garbage) == 1
    assert "the unambiguous range" in garbage[0]
    assert not any(name.startswith("impossible") for name in said)


def test_a_recording_that_is_mostly_wrapped_is_refused_with_the_reason(
    recording: Recording,
) -> None:
    said = _sentences(recording, 0.4)
    assert "they show targets beyond it" in said["impossible wrapping"]


def test_shuffled_images_are_not_called_wrapped(recording: Recording) -> None:
    """Whatever the frequency: errors of metres are near a multiple of the range by chance."""
    depth = np.asarray(recording.depth)
    order = np.random.default_rng(1).permutation(len(depth))
    for frequency in (60e6, 100e6, 150e6):
        changed = replace(recording, depth=depth[order], modulation_frequency=frequency)
        found = examine(Dataset((changed,)))
        assert found.impossible
        assert not any("unambiguous range" in one.sentence for one in found.findings)


def test_whole_ranges_but_not_none_are_wrapped() -> None:
    size = unambiguous_range(60e6)
    errors = np.array([0.0, 0.05, size, -size + 0.05, 2 * size, size / 2, size + 0.2])
    assert wrapped(errors, 60e6).tolist() == [False, False, True, True, True, False, False]
    assert not wrapped(errors, None).any()
