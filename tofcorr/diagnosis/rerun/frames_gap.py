"""The gap between a recording and frames of a simulator, pixel by pixel."""

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import resampled
from tofcorr.diagnosis.rerun.excess import Excess
from tofcorr.diagnosis.sums.noise import Neighbours, gap_weight, robust_weights
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.geometry.ranges import radial_distance_from_z_depth
from tofcorr.geometry.rays import ray_directions

# Resamples of the poses behind an interval. The usual number for 95 %.
_RESAMPLES = 400


class FramesGap:
    """Root mean square of measured minus simulated distances, less the noise."""

    def __init__(
        self, observations: Observations, sigma: Tensor, floor_factor: float, counted: Tensor
    ) -> None:
        self._observations = observations
        self._counted = counted
        self._sigma = sigma
        self._floor_factor = floor_factor

    def of(self, depth: Tensor) -> float:
        """Return the gap to depth images (F, H, W) of the recording's kind, metres."""
        return self._excess(depth).gap()

    def interval(self, depth: Tensor, seed: int) -> tuple[float, float]:
        """Return the 95 % interval of the gap: poses are drawn anew."""
        generator = torch.Generator().manual_seed(seed)
        resamples = resampled(self._observations.num_units, _RESAMPLES, generator)
        gaps = self._excess(depth).gaps(resamples)
        low, high = gaps.quantile(torch.tensor([0.025, 0.975], dtype=gaps.dtype)).tolist()
        return low, high

    def _excess(self, depth: Tensor) -> Excess:
        observations, sigma = self._observations, self._sigma
        simulated = radial_at(observations, depth)
        known = simulated.isfinite() & (simulated > 0) & self._counted
        residual = torch.where(known, observations.measured - simulated, 0.0)
        trust = robust_weights(residual, sigma, Neighbours(observations).common(residual))
        share = trust * gap_weight(sigma) * known
        return Excess.of(observations, residual, share, self._floor_factor * sigma)


def radial_at(observations: Observations, depth: Tensor) -> Tensor:
    """Return the distances of the chosen pixels in depth images (F, H, W), (M,), metres."""
    recording = observations.recording
    if recording.depth_kind == "z":
        depth = radial_distance_from_z_depth(depth, ray_directions(recording.camera))
    return depth.reshape(len(depth), -1)[observations.frame, observations.pixel].double()
