"""A study whose coefficients are fitted to some poses alone, so that the others are held out."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from tofcorr.diagnosis.sums.study import Study


def fitted_to(study: Study, units: Tensor, names: Sequence[str]) -> Study:
    """Return the study with ordinary sums of some poses alone, of which coefficients are fitted.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
        names: Effects with columns that the model has; the sums of all others are left out.
    """
    sums = study.sums.of(names)
    sums = replace(sums, plain=sums.plain * units.double()[:, None, None])
    return replace(study, system=replace(study.system, sums=sums))
