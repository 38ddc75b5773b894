"""The gap between a recording and frames of a simulator, pixel by pixel."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import gap_weight
from tofcorr.diagnosis.sums.robust_weights import Neighbours, robust_weights
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
        squares, weight = self._sums(depth)
        return max(float(squares.sum() / weight.sum()), 0.0) ** 0.5

    def interval(self, depth: Tensor, seed: int) -> tuple[float, float]:
        """Return the 95 % interval of the gap: poses are drawn anew."""
        squares, weight = self._sums(depth)
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randint(len(weight), (_RESAMPLES, len(weight)), generator=generator)
        ratios = (squares[drawn].sum(1) / weight[drawn].sum(1)).clamp(min=0).sqrt()
        low, high = ratios.quantile(torch.tensor([0.025, 0.975], dtype=ratios.dtype)).tolist()
        return low, high

    def _sums(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Return weighted squares less the noise, and weights, of every pose, each (U,)."""
        observations, sigma = self._observations, self._sigma
        simulated = radial_at(observations, depth)
        known = simulated.isfinite() & (simulated > 0) & self._counted
        residual = torch.where(known, observations.measured - simulated, 0.0)
        trust = robust_weights(residual, sigma, Neighbours(observations).common(residual))
        share = trust * gap_weight(sigma) * known
        unit = observations.unit[observations.frame]
        squares = share * (residual**2 - (self._floor_factor * sigma) ** 2)
        zeros = torch.zeros(observations.num_units, dtype=torch.float64)
        return zeros.index_add(0, unit, squares), zeros.index_add(0, unit, share)


def radial_at(observations: Observations, depth: Tensor) -> Tensor:
    """Return the distances of the chosen pixels in depth images (F, H, W), (M,), metres."""
    recording = observations.recording
    if recording.depth_kind == "z":
        depth = radial_distance_from_z_depth(depth, ray_directions(recording.camera))
    return depth.reshape(len(depth), -1)[observations.frame, observations.pixel].double()
