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
    from tofcorr.training.result import TrainingResult as TrainingResult
    from tofcorr.training.run import train as train

_PUBLIC = {
    "DriftResult": "tofcorr.drift.result",
    "EvaluationResult": "tofcorr.comparison.evaluate",
    "SelectionResult": "tofcorr.comparison.select",
    "check": "tofcorr.drift.check",
    "evaluate": "tofcorr.comparison.evaluate",
    "select": "tofcorr.comparison.select",
    "CameraIntrinsics": "tofcorr.geometry.camera",
    "CalibrationDataError": "tofcorr.errors",
    "ConfigError": "tofcorr.errors",
    "DepthCorrection": "tofcorr.module.depth_correction",
    "ExportError": "tofcorr.errors",
    "FrameError": "tofcorr.errors",
    "Recording": "tofcorr.data.recording",
    "RecordingWriter": "tofcorr.data.writing",
    "SensorModel": "tofcorr.sensor.model",
    "StateError": "tofcorr.errors",
    "TofcorrError": "tofcorr.errors",
    "TrainingResult": "tofcorr.training.result",
    "DiagnosisResult": "tofcorr.diagnosis.report.result",
    "diagnose": "tofcorr.diagnosis.diagnose",
    "degrade": "tofcorr.sensor.degrade",
    "inspect": "tofcorr.plausibility.examine",
    "Inspection": "tofcorr.plausibility.finding",
    "simulate": "tofcorr.simulation.simulator",
    "train": "tofcorr.training.run",
}
__all__ = [
    "CalibrationDataError",
    "CameraIntrinsics",
    "ConfigError",
    "DepthCorrection",
    "DiagnosisResult",
    "DriftResult",
    "EvaluationResult",
    "ExportError",
    "FrameError",
    "Inspection",
    "Recording",
    "RecordingWriter",
    "SelectionResult",
    "SensorModel",
    "StateError",
    "TofcorrError",
    "TrainingResult",
    "__version__",
    "check",
    "degrade",
    "diagnose",
    "evaluate",
    "inspect",
    "select",
    "simulate",
    "train",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'tofcorr' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
