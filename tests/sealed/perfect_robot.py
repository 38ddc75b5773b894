"""A recording as a perfect robot and a camera of hardly any noise would have made it."""

from dataclasses import replace

import numpy as np

from benchmarks.renewed.recording import Recorded, Truth, depth_over_range


def exactly(rng: np.random.Generator, recorded: Recorded, truth: Truth) -> Recorded:
    """The same recording at the true poses, without rounding, with 0.2 mm of noise."""
    faint = truth.expected + 2e-4 * rng.standard_normal(truth.expected.shape)
    depth = np.where(np.isnan(recorded.depth), np.nan, faint * depth_over_range(recorded.world))
    return replace(recorded, depth=depth, stated_poses=recorded.world.world_from_tool())
