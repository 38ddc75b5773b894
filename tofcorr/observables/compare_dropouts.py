"""Compares the missing pixels of a recording with those of a simulated one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcorr.observables.dropouts import DropoutMeasurement
from tofcorr.observables.matched import Matched
from tofcorr.observables.pose_tests import Interval

# Smallest difference of the shares that is reported: one pixel in 500. Chosen: what the check of
# simulated pairs measures the share to.
_MATERIAL_SHARE = 0.002
# Missing pixels are blamed on the border if their share there is this many times that elsewhere.
# Chosen.
_BORDER = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class DropoutComparison:
    """Missing pixels among those on the target.

    Attributes:
        real: Measurement of the recording.
        sim: Measurement of the simulated one.
        real_share: Of the recording, over the pixels compared.
        sim_share: Of the simulated one there.
        difference_interval: 95 % interval of real less simulated; None: fewer than six poses.
        p_value: Of equal shares; None: fewer than six poses.
        saturated_p: P-value of equal shares of saturated pixels; None: fewer than six poses.
        paired: Whether both show the same poses.
        explained_by: What of the camera the simulator lacks or exaggerates; empty where nothing is
            significant and material.
    """

    real: DropoutMeasurement
    sim: DropoutMeasurement
    real_share: float
    sim_share: float
    difference_interval: Interval | None
    p_value: float | None
    saturated_p: float | None
    paired: bool
    explained_by: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the block `dropouts` of diagnosis.json."""
        ends = self.difference_interval
        return {
            "real_share": round(self.real_share, 5),
            "sim_share": round(self.sim_share, 5),
            "p_value": self.p_value,
            "difference_ci": None if ends is None else [round(end, 5) for end in ends],
            "same_poses": self.paired,
            "saturated_p_value": self.saturated_p,
            "real": _parts(self.real),
            "sim": _parts(self.sim),
            "explained_by": list(self.explained_by),
        }


def compare_dropouts(
    both: Matched,
    real: DropoutMeasurement,
    sim: DropoutMeasurement,
    random: np.random.Generator,
    level: float,
) -> DropoutComparison:
    """Compare the shares of missing and of saturated pixels.

    Args:
        both: The pixels to compare.
        real: Measurement of the recording.
        sim: Measurement of the simulated one.
        random: Of resamples and permutations.
        level: Significance level.
    """
    weights = (both.real.frames, both.sim.frames)
    missing = both.sums(
        both.real.missing / both.real.frames, both.sim.missing / both.sim.frames, weights
    )
    saturated = both.sums(
        both.real.saturated / both.real.frames, both.sim.saturated / both.sim.frames, weights
    )
    shares = np.nan_to_num(missing.means())
    p_value, saturated_p = missing.difference_p(random), saturated.difference_p(random)
    causes: list[str] = []
    if _matters(shares, p_value, level):
        causes.append(_cause(real if shares[0] > shares[1] else sim))
    if _matters(np.nan_to_num(saturated.means()), saturated_p, level):
        causes = list(dict.fromkeys((*causes, "saturation")))
    return DropoutComparison(
        real=real,
        sim=sim,
        real_share=float(shares[0]),
        sim_share=float(shares[1]),
        difference_interval=missing.difference_interval(random),
        p_value=p_value,
        saturated_p=saturated_p,
        paired=both.paired,
        explained_by=tuple(causes),
    )


def _matters(shares: np.ndarray, p_value: float | None, level: float) -> bool:
    large = abs(shares[0] - shares[1]) > _MATERIAL_SHARE
    return bool(large and p_value is not None and p_value < level)


def _cause(dropouts: DropoutMeasurement) -> str:
    """Return what the missing pixels of a recording look like."""
    if dropouts.saturated_missing > dropouts.share / 2:
        return "saturation"
    if dropouts.model.amplitude_at_half is not None:
        return "amplitude threshold"
    if dropouts.border_share > _BORDER * dropouts.centre_share:
        return "missing border of the image"
    return "missing pixels at any amplitude"


def _parts(dropouts: DropoutMeasurement) -> dict[str, Any]:
    """Return what one recording shows by itself."""
    return {
        "share": round(dropouts.share, 5),
        "saturated_share": round(dropouts.saturated_share, 5),
        "saturated_missing": round(dropouts.saturated_missing, 5),
        "border_share": round(dropouts.border_share, 5),
        "centre_share": round(dropouts.centre_share, 5),
        "model": dropouts.model.model_dump(exclude={"saturated_share"}),
        "amplitude_recorded": dropouts.amplitude_recorded,
    }
