"""Time-of-flight depth correction, hand-eye calibration and diagnosis of the sim-to-real gap.

The public names load on first use, so that `import tofcorr` and `tofcorr --help` cost nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from tofcorr.version import __version__

if TYPE_CHECKING:
    from tofcorr.comparison.evaluate import EvaluationResult as EvaluationResult
    from tofcorr.comparison.evaluate import evaluate as evaluate
    from tofcorr.comparison.select import SelectionResult as SelectionResult
    from tofcorr.comparison.select import select as select
    from tofcorr.data.recording import Recording as Recording
    from tofcorr.data.writing import RecordingWriter as RecordingWriter
    from tofcorr.diagnosis.diagnose import diagnose as diagnose
    from tofcorr.diagnosis.report.result import DiagnosisResult as DiagnosisResult
    from tofcorr.drift.check import check as check
    from tofcorr.drift.result import DriftResult as DriftResult
    from tofcorr.errors import CalibrationDataError as CalibrationDataError
    from tofcorr.errors import ConfigError as ConfigError
    from tofcorr.errors import ExportError as ExportError
    from tofcorr.errors import FrameError as FrameError
    from tofcorr.errors import StateError as StateError
    from tofcorr.errors import TofcorrError as TofcorrError
    from tofcorr.geometry.camera import CameraIntrinsics as CameraIntrinsics
    from tofcorr.module.depth_correction import DepthCorrection as DepthCorrection
    from tofcorr.plausibility.examine import inspect as inspect
    from tofcorr.plausibility.finding import Inspection as Inspection
    from tofcorr.sensor.degrade import degrade as degrade
    from tofcorr.sensor.model import SensorModel as SensorModel
    from tofcorr.simulation.simulator import simulate as simulate
    from tofcorr.training.run import TrainingResult as TrainingResult
    from tofcorr.training.run import train as train

_NAMES = {
    "tofcorr.comparison.evaluate": ("EvaluationResult", "evaluate"),
    "tofcorr.comparison.select": ("SelectionResult", "select"),
    "tofcorr.data.recording": ("Recording",),
    "tofcorr.data.writing": ("RecordingWriter",),
    "tofcorr.diagnosis.diagnose": ("diagnose",),
    "tofcorr.diagnosis.report.result": ("DiagnosisResult",),
    "tofcorr.drift.check": ("check",),
    "tofcorr.drift.result": ("DriftResult",),
    "tofcorr.errors": (
        "CalibrationDataError",
        "ConfigError",
        "ExportError",
        "FrameError",
        "StateError",
        "TofcorrError",
    ),
    "tofcorr.geometry.camera": ("CameraIntrinsics",),
    "tofcorr.module.depth_correction": ("DepthCorrection",),
    "tofcorr.plausibility.examine": ("inspect",),
    "tofcorr.plausibility.finding": ("Inspection",),
    "tofcorr.sensor.degrade": ("degrade",),
    "tofcorr.sensor.model": ("SensorModel",),
    "tofcorr.simulation.simulator": ("simulate",),
    "tofcorr.training.run": ("TrainingResult", "train"),
}
_PUBLIC = {name: module for module, names in _NAMES.items() for name in names}
__all__ = ["__version__", *sorted(_PUBLIC)]  # noqa: PLE0604  # pyright: ignore


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'tofcorr' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
