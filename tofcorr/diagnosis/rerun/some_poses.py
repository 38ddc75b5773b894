"""A study whose coefficients are fitted to some poses alone, so that the others are held out."""

from dataclasses import replace

from torch import Tensor

from tofcorr.diagnosis.sums.study import Study


def fitted_to(study: Study, units: Tensor) -> Study:
    """Return the study with the sums of some poses alone, of which coefficients are fitted.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
    """
    blocks = study.system.blocks
    count = units.double()
    even = replace(
        blocks.even,
        gram=blocks.even.gram * count[:, None, None],
        score=blocks.even.score * count[:, None],
    )
    return replace(study, system=replace(study.system, blocks=replace(blocks, even=even)))
