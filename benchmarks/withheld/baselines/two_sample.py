"""A classifier that tries to tell the recording from its simulation (Lopez-Paz and Oquab 2017)."""

import numpy as np
from scipy.stats import binom
from sklearn.ensemble import HistGradientBoostingClassifier

from benchmarks.withheld.baselines.covariates import SPEAKS_FOR, Table
from benchmarks.withheld.outcomes import Said

SAMPLE = 8_000
LEVEL = 0.05


def two_sample(table: Table, rng: np.random.Generator) -> Said:
    """Real residuals against simulated ones of the same spread; importances by permutation.

    Half the images train the classifier; a pixel counts as independent in the test of its accuracy
    on the other half.
    """
    rows = rng.choice(len(table.residual), min(SAMPLE, len(table.residual)), replace=False)
    names = list(table.covariates)
    covariates = np.column_stack([table.covariates[name][rows] for name in names])
    real = table.standardised[rows]
    simulated = rng.permutation(real)
    x = np.concatenate(
        [np.column_stack([real, covariates]), np.column_stack([simulated, covariates])]
    )
    label = np.repeat([1, 0], len(rows))
    train = np.tile(rng.permutation(table.image.max() + 1)[table.image[rows]] % 2 == 0, 2)
    model = HistGradientBoostingClassifier(max_iter=80, max_leaf_nodes=16, random_state=0).fit(
        x[train], label[train]
    )
    tested, truth = x[~train], label[~train]
    right = (model.predict(tested) == truth).sum()
    if binom.sf(right - 1, len(truth), 0.5) > LEVEL:
        return Said()
    importance = []
    for j in range(1, x.shape[1]):
        shuffled = tested.copy()
        shuffled[:, j] = rng.permutation(shuffled[:, j])
        importance.append(right - (model.predict(shuffled) == truth).sum())
    named = SPEAKS_FOR[names[int(np.argmax(importance))]]
    return Said(effects=named[:1], sets=(frozenset(named),))
