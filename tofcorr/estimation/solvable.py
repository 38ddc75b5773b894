"""What is said where equations have no solution."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from tofcorr.errors import CalibrationDataError

_USUAL = (
    "the frames do not differ enough, or poses, planes or depth are far off; see `tofcorr inspect`."
)


@contextmanager
def solvable(path: Path, task: str, reason: str = _USUAL) -> Iterator[None]:
    """Refuse a recording whose equations the block finds to have no solution.

    Args:
        path: Of the recording.
        task: What solves them: the fit, for example.
        reason: Why there may be no solution, and what to do.

    Raises:
        CalibrationDataError: A matrix of the block is singular.
    """
    try:
        yield
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
        raise CalibrationDataError(
            f"{path}: the equations of the {task} have no solution: {reason}"
        ) from None
