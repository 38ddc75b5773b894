"""A target beyond the unambiguous range is measured one range nearer, and that is said."""

from dataclasses import replace

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import SPEED_OF_LIGHT, unambiguous_range, wrapped
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine


def _sentences(white_wall: Recording, share_beyond: float) -> dict[str, str]:
    """What is said of a camera whose range ends below this share of the distances."""
    depth = np.asarray(white_wall.depth)
    size = float(np.nanquantile(depth, 1 - share_beyond))
    wrapped_depth, frequency = np.mod(depth, size).astype(np.float32), SPEED_OF_LIGHT / (2 * size)
    changed = replace(white_wall, depth=wrapped_depth, modulation_frequency=frequency)
    found = examine(Dataset((changed,)))
    return {f"{one.severity} {one.check}": one.sentence for one in found.findings}


def test_few_wrapped_pixels_are_garbage_and_most_are_impossible(
    white_wall: Recording,
) -> None:
    said = _sentences(white_wall, 0.02)
    garbage = [text for name, text in said.items() if name.endswith("garbage")]
    assert len(garbage) == 1
    assert "the unambiguous range" in garbage[0]
    assert not any(name.startswith("impossible") for name in said)
    said = _sentences(white_wall, 0.4)
    assert "they show targets beyond it" in said["impossible wrapping"]


def test_shuffled_images_are_not_called_wrapped(white_wall: Recording) -> None:
    """Whatever the frequency: errors of metres are near a multiple of the range by chance."""
    depth = np.asarray(white_wall.depth)
    order = np.random.default_rng(1).permutation(len(depth))
    for frequency in (60e6, 150e6):
        changed = replace(white_wall, depth=depth[order], modulation_frequency=frequency)
        found = examine(Dataset((changed,)))
        assert found.impossible
        assert not any("unambiguous range" in one.sentence for one in found.findings)


def test_whole_ranges_but_not_none_are_wrapped() -> None:
    size = unambiguous_range(60e6)
    errors = np.array([0.0, 0.05, size, -size + 0.05, 2 * size, size / 2, size + 0.2])
    assert wrapped(errors, 60e6).tolist() == [False, False, True, True, True, False, False]
    assert not wrapped(errors, None).any()
