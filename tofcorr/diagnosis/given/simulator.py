"""The interface of a simulator under diagnosis."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base_fit import SimulatorError
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.simulation.options import SimulatorOptions

SimulatorKind = Literal["given", "rendered", "fitted"]
"""`given`: options of the built-in simulator; `rendered`: frames of any other; `fitted`: none was
named, so that a simulator is fitted to the recording."""


class GivenSimulator(ABC):
    """A simulator that a user named.

    Class attributes:
        kind: What `diagnosis.json` calls it.

    Attributes:
        options: Of the built-in simulator; None where another one rendered frames.
    """

    kind: ClassVar[SimulatorKind]
    options: SimulatorOptions | None = None

    def rendered_frames(self, recording: Recording) -> Recording | None:
        """Return the frames that another simulator rendered; None for the built-in one.

        Args:
            recording: The real recording.
        """
        del recording
        return None

    @abstractmethod
    def simulate(self, observations: Observations, options: DiagnosisOptions) -> SimulatorError:
        """Return the error that the simulator makes in the chosen pixels of a recording.

        Raises:
            CalibrationDataError: The simulator cannot be compared with the recording.
        """
