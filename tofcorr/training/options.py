"""The options of a training, as YAML gives them."""

from typing import ClassVar

from pydantic import NonNegativeInt

from tofcorr.fit.problem import FitOptions
from tofcorr.pixels.dataset import SplitOptions
from tofcorr.pixels.sample import MaskOptions


class TrainingOptions(FitOptions, MaskOptions):
    """All options of `tofcorr.train` and `tofcorr train`: the fit, the pixels used, and the split.

    Attributes:
        name: The model's name in reports.
        split: The frames held out.
        advice: For how many further poses the report gives advice; 0: for none.
        figures: Whether TensorBoard is given figures; the numbers of the fit it gets anyway.
    """

    config_folder: ClassVar[str] = "train"

    name: str
    split: SplitOptions = SplitOptions()
    advice: NonNegativeInt = 5
    figures: bool = True
