"""What a model needs and a recording lacks is refused, with a way out."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kinds_of_terms import DOMAIN
from small_recordings import write_small_recording

from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.data.recording import Recording
from tofcorr.error_terms.base import Interval
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.problem import build_model, refuse_missing_inputs
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.calibration import TrainingOptions


@pytest.mark.parametrize("command", [None, EvaluationOptions, SelectionOptions])
def test_the_model_named_by_the_refusal_of_another_takes_the_recording(
    command: type[EvaluationOptions | SelectionOptions] | None, tmp_path: Path
) -> None:
    """The refusal said no more than that, or `select` advised a configuration of `train`."""
    folder = write_small_recording(tmp_path / "bare", amplitude=None, modulation_frequency=None)
    data = Dataset((Recording.open(folder),))
    for refused in ("ea", "periodic"):
        with pytest.raises(CalibrationDataError, match="--config e0") as error:
            refuse_missing_inputs(data, resolve_options(TrainingOptions, refused).model)
    (change,) = re.findall(r"--set '(.*?)'", str(error.value))
    named = resolve_options(TrainingOptions, "e0")
    if command is not None:
        (named,) = resolve_options(command, "paper", [change]).models
    refuse_missing_inputs(data, named.model)


def test_amplitudes_that_are_all_the_same_are_no_amplitudes(tmp_path: Path) -> None:
    # A driver without an infrared image wrote zeros: the training ended in a traceback.
    dark = np.zeros((6, 5, 7), np.float32)
    data = Dataset((Recording.open(write_small_recording(tmp_path / "dark", amplitude=dark)),))
    domain = replace(DOMAIN, amplitude=Interval(0, 0), normalised_amplitude=None)
    with pytest.raises(CalibrationDataError, match=r"holds 0 in every pixel.*--config e0"):
        build_model(data, resolve_options(TrainingOptions, "ea").model, domain)
    build_model(data, resolve_options(TrainingOptions, "e0").model, domain)
