"""A study whose coefficients are fitted to some poses alone, so that the others are held out."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from tofcorr.diagnosis.sums.linear_system import Sums
from tofcorr.diagnosis.sums.study import Study


def fitted_to(study: Study, units: Tensor, names: Sequence[str]) -> Study:
    """Return the study with even sums of some poses alone, of which coefficients are fitted.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
        names: Effects with columns that the model has; the sums of all others are left out.
    """
    blocks = study.system.blocks
    gram, score, _ = blocks.even.of(names)
    count = units.double()
    even = Sums(
        gram=gram * count[:, None, None],
        score=score * count[:, None],
        layout=blocks.layout.only(names),
    )
    return replace(study, system=replace(study.system, blocks=replace(blocks, even=even)))
