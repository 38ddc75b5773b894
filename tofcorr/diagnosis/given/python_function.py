"""A simulator that is a Python function, from a recording to frames at its poses."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np

from tofcorr.data.header import refuse_unless_rigid
from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.diagnosis.given.rendered import RenderedSimulator
from tofcorr.diagnosis.given.simulator import GivenSimulator, Simulated
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.errors import CalibrationDataError
from tofcorr.files.staged import scratch_folder

_KEYS = ("depth", "amplitude", "tool_from_camera")


class PythonSimulator(GivenSimulator):
    """A function that renders the poses of a recording.

    Args:
        function: Takes the recording; returns its frames, an array (N, H, W) of depth in metres,
            of the recording's own kind, NaN or 0 where there is none, or a mapping with `depth`
            and optionally `amplitude` (N, H, W) and `tool_from_camera` (4, 4). Without the last
            the hand-eye transform of the recording is taken to be the simulator's.
    """

    kind = "rendered"

    def __init__(self, function: Callable[[Recording], Any]) -> None:
        self._function = function
        self._rendered: RenderedSimulator | None = None

    def rendered_frames(self, recording: Recording) -> Recording:
        """Return the function's frames as a recording; it is called once."""
        if self._rendered is None:
            self._rendered = self.rendered(recording)
        return self._rendered.recording

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> Simulated:
        """Call the function, and compare its frames pixel by pixel."""
        self._rendered = self.rendered(observations.recording)
        with _refused_by_name(self._rendered.recording.path):
            return self._rendered.simulate(observations, options)

    def rendered(self, recording: Recording) -> RenderedSimulator:
        """Call the function, and return its frames as a recording in a temporary folder.

        Raises:
            CalibrationDataError: What it returned does not have the shape of the recording.
        """
        frames = _frames_of(self._function(recording), recording)
        pose = frames.pop("tool_from_camera", recording.tool_from_camera)
        with ExitStack() as stack:
            out = stack.enter_context(scratch_folder()) / "frames"
            with _refused_by_name(out):
                write_recording(
                    out,
                    camera=recording.camera,
                    depth_kind=recording.depth_kind,
                    rows=recording.frames,
                    mask=None if recording.mask is None else np.asarray(recording.mask),
                    modulation_frequency=recording.modulation_frequency,
                    tool_from_camera=pose,
                    **frames,
                )
                simulator = RenderedSimulator(Recording.open(out))
            finalize(simulator, stack.pop_all().close)
        return simulator


@contextmanager
def _refused_by_name(path: Path) -> Iterator[None]:
    """Call the frames what they are in an error, and not by a scratch folder that nobody made."""
    try:
        yield
    except CalibrationDataError as refusal:
        sentence = str(refusal).replace(str(path), "the frames that the function returned")
        raise CalibrationDataError(sentence) from None


def _frames_of(returned: Any, recording: Recording) -> dict[str, Any]:  # noqa: ANN401 - checked here
    """Check what a function returned; return arrays by name."""
    given = dict(returned) if isinstance(returned, Mapping) else {"depth": returned}
    unknown = sorted(set(given) - set(_KEYS))
    if unknown or "depth" not in given:
        raise CalibrationDataError(
            "The simulator must return an array of depth, or a mapping with 'depth' and optionally "
            "'amplitude' and 'tool_from_camera'; it returned "
            f"{', '.join(map(str, given)) or 'nothing'}."
        )
    shape = (recording.num_frames, recording.camera.height, recording.camera.width)
    expected = {"depth": shape, "amplitude": shape, "tool_from_camera": (4, 4)}
    checked = {}
    for name, values in given.items():
        try:
            array = np.asarray(values, dtype=np.float64 if expected[name] == (4, 4) else np.float32)
        except (TypeError, ValueError, RuntimeError) as error:
            # Of a tensor that has a gradient, or lies on a GPU, torch says what to call first.
            raise CalibrationDataError(
                f"The simulator's {name} must be numbers of shape {expected[name]}, got "
                f"{type(values).__name__} ({error})"
            ) from None
        if array.shape != expected[name]:
            raise CalibrationDataError(
                f"The simulator's {name} must have the recording's shape {expected[name]}, got "
                f"{array.shape}."
            )
        checked[name] = array
    if "tool_from_camera" in checked:
        try:
            refuse_unless_rigid(checked["tool_from_camera"])
        except ValueError as error:
            raise CalibrationDataError(f"The simulator's tool_from_camera: {error}.") from None
    return checked
