"""What a model needs and a recording lacks is refused, with a way out."""

from pathlib import Path

import pytest
from small_recordings import write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.inputs import refuse_missing_inputs
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.options import TrainingOptions


def test_a_model_named_by_the_refusal_of_another_takes_the_recording(tmp_path: Path) -> None:
    # The default model's refusal of a recording without amplitudes said no more than that.
    folder = write_small_recording(tmp_path / "bare", amplitude=None, modulation_frequency=None)
    data = Dataset((Recording.open(folder),))
    for refused in ("ea", "periodic"):
        with pytest.raises(CalibrationDataError, match="--config e0"):
            refuse_missing_inputs(data, resolve_options(TrainingOptions, refused).model)
    refuse_missing_inputs(data, resolve_options(TrainingOptions, "e0").model)
