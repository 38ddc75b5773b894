"""The public names, each from where it is defined: what `__init__.py` loads on first use."""

from tofcorr.comparison.evaluate import EvaluationResult as EvaluationResult
from tofcorr.comparison.evaluate import evaluate as evaluate
from tofcorr.comparison.named import train_with as train_with
from tofcorr.comparison.runs import RunComparison as RunComparison
from tofcorr.comparison.runs import compare as compare
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
from tofcorr.examples.example import example as example
from tofcorr.geometry.camera import CameraIntrinsics as CameraIntrinsics
from tofcorr.live.calibration import Known as Known
from tofcorr.live.calibration import LiveCalibration as LiveCalibration
from tofcorr.module.depth_correction import DepthCorrection as DepthCorrection
from tofcorr.module.loading import load_corrector as load_corrector
from tofcorr.plausibility.examine import inspect as inspect
from tofcorr.plausibility.finding import Inspection as Inspection
from tofcorr.sensor.degrade import degrade as degrade
from tofcorr.sensor.model import SensorModel as SensorModel
from tofcorr.simulation.simulator import simulate as simulate
from tofcorr.training.pool import pool as pool
from tofcorr.training.rig import RigResult as RigResult
from tofcorr.training.rig import rig as rig
from tofcorr.training.run import TrainingResult as TrainingResult
from tofcorr.training.run import train as train
from tofcorr.training.update import update as update
from tofcorr.version import __version__ as __version__

__all__: list[str]
