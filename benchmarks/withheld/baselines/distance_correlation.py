"""Distance correlation (Szekely, Rizzo and Bakirov 2007) of the residual with each covariate."""

import numpy as np
from scipy.stats import chi2

from benchmarks.withheld.baselines.covariates import SPEAKS_FOR, Table
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.outcomes import Said

SAMPLE = 1200
LEVEL = 0.05


def distance_correlation(table: Table, rng: np.random.Generator) -> Said:
    """The strongest, if its chi-square test (Shen et al. 2022) holds after Bonferroni."""
    rows = rng.choice(len(table.residual), min(SAMPLE, len(table.residual)), replace=False)
    y = _centred(table.standardised[rows])
    names = list(table.covariates)
    strengths = np.array(
        [_correlation(_centred(table.covariates[name][rows]), y) for name in names]
    )
    best = int(np.argmax(strengths))
    if chi2.sf(len(rows) * strengths[best] + 1, 1) > LEVEL / len(names):
        return Said()
    named = SPEAKS_FOR[names[best]]
    return Said(effects=named[:1], sets=(frozenset(named),))


def _centred(values: Array) -> Array:
    """U-centred distance matrix."""
    scale = np.std(values) or 1.0
    distance = np.abs(np.subtract.outer(values, values)) / scale
    n = len(values)
    rows = distance.sum(0)
    centred = distance - rows / (n - 2) - rows[:, None] / (n - 2) + rows.sum() / ((n - 1) * (n - 2))
    np.fill_diagonal(centred, 0.0)
    return centred


def _correlation(a: Array, b: Array) -> float:
    size = np.sqrt((a * a).sum() * (b * b).sum())
    return float((a * b).sum() / size) if size > 0 else 0.0
