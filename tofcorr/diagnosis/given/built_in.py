"""The built-in simulator, run at the recording's own poses without noise."""

import torch

from tofcorr.diagnosis.given.simulator import GivenSimulator, Simulated
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.rerun.twin import twin_distance
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.diagnosis.sums.simulator_error import SimulatorError
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import default_hand_eye


class BuiltInSimulator(GivenSimulator):
    """Options of the built-in simulator.

    Args:
        options: What to run.
    """

    kind = "given"

    def __init__(self, options: SimulatorOptions) -> None:
        self._options = options

    @property
    def options(self) -> SimulatorOptions:
        """What is run."""
        return self._options

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> Simulated:
        """Run the simulator at the recording's poses."""
        del options
        pose = default_hand_eye(self._options, observations.recording)
        distance = twin_distance(observations, self._options, pose)
        error = SimulatorError(
            error=distance - predicted_distance(observations, pose),
            sigma=torch.zeros_like(distance),
            tool_from_camera=pose,
            uncertain=distance.new_zeros(len(distance), 0),
        )
        return Simulated(error=error)
