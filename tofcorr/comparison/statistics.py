"""Means of held-out errors with their intervals, the ranking of models, and tables of both."""

from collections.abc import Mapping
from math import nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from tofcorr.digits import aligned
from tofcorr.estimation.robust import LEVEL, student_quantile, student_tail
from tofcorr.training.report import number_or_none


class Estimate:
    """A mean of values with its interval.

    Splits of the same frames share most of their training frames, so their errors are not
    independent: the variance of the mean is enlarged (Nadeau and Bengio 2003, the corrected
    resampled t-test).

    Args:
        values: Shape (N,); for six folds the half width is 2.57 standard errors.
        overlap: By how many variances of one value; n_test / n_train for random splits.

    Attributes:
        mean: The mean.
        standard_deviation: Of the values; as all below NaN for a single value.
        standard_error: Of the mean.
        half_width: Half the 95 % interval, of Student's t.
        p_value: Two-sided, of the hypothesis that the true mean is zero.
        degrees_of_freedom: Values minus one.
    """

    def __init__(self, values: np.ndarray, overlap: float = 0.0) -> None:
        self.mean, self.degrees_of_freedom = float(np.mean(values)), len(values) - 1
        several = self.degrees_of_freedom > 0
        self.standard_deviation = float(np.std(values, ddof=1)) if several else nan
        self.standard_error = self.standard_deviation * sqrt(1 / len(values) + overlap)
        # Two columns that are equal in every split have no difference to test.
        self.p_value = float(self.mean == 0) if several else nan
        if self.standard_error > 0:
            ratio = abs(self.mean) / self.standard_error
            self.p_value = 2 * student_tail(ratio, self.degrees_of_freedom)
        quantile = student_quantile(1 - LEVEL / 2, self.degrees_of_freedom)
        self.half_width = quantile * self.standard_error

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


class Ranking:
    """The models of one cross-validation, compared on poses that they were not fitted to.

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

    Attributes:
        errors: Each model's held-out error over the poses, millimetres, in the order given.
        behind: Each model's error minus that of the best, pose by pose, millimetres.
        complexity: Number of unknowns of each model.
        best: The model of the smallest held-out error.
        winner: The simplest model within one standard error of the best.
        ties: Models whose 95 % interval of the difference to the winner contains zero.
    """

    def __init__(
        self, errors: Mapping[str, np.ndarray], complexity: Mapping[str, int], groups: int
    ) -> None:
        def less(other: np.ndarray | float) -> dict[str, Estimate]:
            overlap = groups / (groups - 1)
            return {k: Estimate(own - other, overlap / len(own)) for k, own in errors.items()}

        own, self.complexity = less(0.0), complexity
        self.errors = own
        self.best = min(own, key=lambda name: (own[name].mean, complexity[name], name))
        self.behind = less(errors[self.best])
        # Of a single pose no standard error is known: then all are near, and all tie.
        near = [name for name, one in self.behind.items() if not one.mean > one.standard_error]
        self.winner = min(near, key=lambda name: (complexity[name], own[name].mean, name))
        differences = less(errors[self.winner]).items()
        close = [name for name, one in differences if not abs(one.mean) > one.half_width]
        self.ties = [name for name in close if name != self.winner]


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
        header, *rows = aligned([self.header, *self.rows])
        rule = "-" * max(map(len, [header, *rows]))
        return "\n".join([self.title, rule, header, rule, *rows, rule, self.note])

    def markdown(self) -> str:
        """Return a Markdown table."""
        rule = [":--", *["--:"] * (len(self.header) - 1)]
        cells = [[cell.replace("|", r"\|") for cell in line] for line in [self.header, *self.rows]]
        lines = [f"| {' | '.join(line)} |" for line in [cells[0], rule, *cells[1:]]]
        return "\n".join([f"**{self.title}**", "", *lines, "", self.note])
