"""From whatever names a simulator to the simulator; the built-in one, run without noise."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tofcorr.data.recording import HEADER_FILE, Recording
from tofcorr.diagnosis.given.rendered import PythonSimulator, RenderedSimulator
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.rerun.simulator import twin_distance
from tofcorr.diagnosis.sums.base_fit import SimulatorError
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.errors import ConfigError
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import default_hand_eye


class BuiltInSimulator(GivenSimulator):
    """Options of the built-in simulator.

    Args:
        options: What to run.
    """

    kind = "given"

    def __init__(self, options: SimulatorOptions) -> None:
        self.options = options

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> SimulatorError:
        """Run the simulator at the recording's poses."""
        del options
        assert self.options is not None
        pose = default_hand_eye(self.options, observations.recording)
        distance = twin_distance(observations, self.options, pose)
        return SimulatorError.exact(distance - predicted_distance(observations, pose), pose)


Simulator = (
    SimulatorOptions
    | Mapping[str, Any]
    | Path
    | str
    | Recording
    | Callable[[Recording], Any]
    | GivenSimulator
)
"""All that `diagnose` accepts as a simulator."""


def open_simulator(sim: Simulator | None) -> GivenSimulator | None:
    """Return the simulator that `sim` names; None for None.

    Args:
        sim: The name of a shipped configuration, a YAML file, keys and values or options of the
            built-in simulator; a recording that any simulator rendered, or its folder; or a
            function from a recording to frames at its poses.

    Raises:
        ConfigError: There is no such configuration, a key is unknown, or it is something else, such
            as an array.
        CalibrationDataError: The folder is not a recording.
    """
    if sim is None or isinstance(sim, GivenSimulator):
        return sim
    if isinstance(sim, Recording):
        return RenderedSimulator(sim)
    if isinstance(sim, str | Path) and Path(sim).is_dir():
        if not (Path(sim) / HEADER_FILE).exists():
            raise ConfigError(
                f"{sim}: a simulator is a YAML file, the name of a shipped configuration, or the "
                f"folder of a recording; this folder has no {HEADER_FILE}."
            )
        return RenderedSimulator(Recording.open(sim))
    if callable(sim):
        return PythonSimulator(sim)
    if not isinstance(sim, SimulatorOptions | Mapping | str | Path):
        raise ConfigError(
            "sim: expected a shipped name, a file, options, a recording or a function, got "
            f"{type(sim).__name__}. Frames in memory are handed over by a function: "
            "sim=lambda recording: frames."
        )
    return BuiltInSimulator(resolve_options(SimulatorOptions, sim))
