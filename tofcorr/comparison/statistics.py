"""Means of held-out errors with their intervals, the ranking of models, and tables of both."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from tofcorr.estimation.robust import LEVEL, student_quantile, student_tail
from tofcorr.training.report import number_or_none


@dataclass(frozen=True)
class Estimate:
    """A mean.

    Attributes:
        mean: The mean.
        standard_deviation: Of the values; as all below NaN for a single value.
        standard_error: Of the mean.
        half_width: Half the 95 % interval, of Student's t.
        p_value: Two-sided, of the hypothesis that the true mean is zero.
        degrees_of_freedom: Values minus one.
    """

    mean: float
    standard_deviation: float
    standard_error: float
    half_width: float
    p_value: float
    degrees_of_freedom: int

    @property
    def significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.p_value < LEVEL

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.mean - self.half_width, self.mean + self.half_width

    def to_mapping(self) -> dict[str, Any]:
        """Return mean, interval and standard deviation for JSON; None where unknown."""
        return {
            "mean": number_or_none(self.mean),
            "ci": [number_or_none(end) for end in self.interval],
            "standard_deviation": number_or_none(self.standard_deviation),
        }


def estimate(values: np.ndarray, overlap: float = 0.0) -> Estimate:
    """Return the mean of values with its interval.

    Splits of the same frames share most of their training frames, so their errors are not
    independent: the variance of the mean is enlarged (Nadeau and Bengio 2003, the corrected
    resampled t-test).

    Args:
        values: Shape (N,); for six folds the half width is 2.57 standard errors.
        overlap: By how many variances of one value; n_test / n_train for random splits.
    """
    mean, dof = float(np.mean(values)), len(values) - 1
    if not dof:
        return Estimate(mean, nan, nan, nan, nan, 0)
    deviation = float(np.std(values, ddof=1))
    error = deviation * sqrt(1 / len(values) + overlap)
    # Two columns that are equal in every split have no difference to test.
    p_value = 2 * student_tail(abs(mean) / error, dof) if error > 0 else float(mean == 0)
    half_width = student_quantile(1 - LEVEL / 2, dof) * error
    return Estimate(mean, deviation, error, half_width, p_value, dof)


@dataclass(frozen=True)
class Ranking:
    """The models of one cross-validation.

    Attributes:
        errors: Each model's held-out error over the poses, millimetres, in the order given.
        behind: Each model's error minus that of the best, pose by pose, millimetres.
        complexity: Number of unknowns of each model.
        best: The model of the smallest held-out error.
        winner: The simplest model within one standard error of the best.
        ties: Models whose 95 % interval of the difference to the winner contains zero.
    """

    errors: dict[str, Estimate]
    behind: dict[str, Estimate]
    complexity: Mapping[str, int]
    best: str
    winner: str
    ties: list[str]


def rank(errors: Mapping[str, np.ndarray], complexity: Mapping[str, int], groups: int) -> Ranking:
    """Compare models on poses that they were not fitted to.

    Poses held out together share a fit, and fits share most of their poses; so the variance of a
    mean over N poses is taken as s^2 / N (1 + K / (K - 1)) with K groups held out in turn, the
    correction of Nadeau and Bengio (2003) for one pose's share. The one-standard-error rule
    (Breiman et al. 1984) is applied to the paired difference, whose standard error is much smaller
    than that of either error: easy images are easy for all models.

    The order of the models does not matter: equal errors are ranked by complexity, then by name.

    Args:
        errors: Each model's held-out error of each pose, shape (N,), in the same order of poses.
        complexity: Number of unknowns of each model.
        groups: K.
    """

    def paired(values: np.ndarray) -> Estimate:
        return estimate(values, groups / (groups - 1) / len(values))

    own = {name: paired(values) for name, values in errors.items()}
    best = min(errors, key=lambda name: (own[name].mean, complexity[name], name))
    behind = {name: paired(values - errors[best]) for name, values in errors.items()}
    # Of a single pose no standard error is known: then all are near, and all tie.
    near = [name for name, one in behind.items() if not one.mean > one.standard_error]
    winner = min(near, key=lambda name: (complexity[name], own[name].mean, name))
    differences = {name: paired(values - errors[winner]) for name, values in errors.items()}
    ties = [
        name
        for name, one in differences.items()
        if name != winner and not abs(one.mean) > one.half_width
    ]
    return Ranking(own, behind, complexity, best, winner, ties)


class Table(NamedTuple):
    """Cells with a title above and a note below.

    Attributes:
        title: What the table shows.
        header: Headings of the columns.
        rows: Cells, as many a row as there are headings.
        note: What the numbers are and how they were found.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str

    def text(self) -> str:
        """Return the table as text, the first column aligned left and the others right."""
        lines = [self.header, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        aligned = [
            "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip()
            for line in lines
        ]
        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        return "\n".join([self.title, rule, aligned[0], rule, *aligned[1:], rule, self.note])

    def markdown(self) -> str:
        """Return a Markdown table."""
        rule = [":--", *["--:"] * (len(self.header) - 1)]
        lines = [
            f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |"
            for line in [self.header, rule, *self.rows]
        ]
        return "\n".join([f"**{self.title}**", "", *lines, "", self.note])
