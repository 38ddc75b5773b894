"""What running the simulator and the sensor that were found says of the findings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import gap_floor
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.closure import Closure, check_in_simulator
from tofcorr.diagnosis.rerun.degraded_stage import DegradedStage, degraded_stage
from tofcorr.diagnosis.rerun.transfer import Transfer, measure_transfer
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.options import SimulatorOptions


@dataclass(frozen=True, kw_only=True)
class Anew:
    """What the simulator with the findings shows; None throughout where it was not run.

    Attributes:
        closure: The gap in the simulator, without and with the effects.
        transfer: Corrections trained on simulated and on real images; None with too few poses.
        degraded: What ideal frames through the sensor leave.
    """

    closure: Closure | None = None
    transfer: Transfer | None = None
    degraded: DegradedStage | None = None


def pieces_of_anew(
    study: Study,
    named: NamedEffects,
    given: SimulatorOptions | None,
    with_effects: SimulatorOptions | None,
    generator: torch.Generator,
    resamples: Tensor,
) -> dict[str, Callable[[], Any]]:
    """Return what runs the simulator with the effects, trains on it, and degrades ideal frames.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
        with_effects: The simulator with the findings; None where another one rendered frames.
        generator: Of the split of the poses and the noise.
        resamples: How often each resample holds each pose, shape (B, U).

    Returns:
        A function for each attribute of `Anew`, the longest first; none needs another.
    """
    return {
        "transfer": lambda: measure_transfer(study, named, given, generator, resamples),
        "degraded": lambda: degraded_stage(
            study, named, with_effects, gap_floor(study, named).size, resamples
        ),
        "closure": lambda: check_in_simulator(study, named, given),
    }
