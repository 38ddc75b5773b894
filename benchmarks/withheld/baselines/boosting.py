"""Gradient boosting on the residuals, and which covariate it cannot do without."""

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from benchmarks.withheld.baselines.covariates import SPEAKS_FOR, Table
from benchmarks.withheld.outcomes import Said

SAMPLE = 12_000
FOLDS = 3


def boosting(table: Table, rng: np.random.Generator) -> Said:
    """Name the most important covariate, by permutation, if held-out images are fitted better."""
    rows = rng.choice(len(table.residual), min(SAMPLE, len(table.residual)), replace=False)
    names = list(table.covariates)
    x = np.column_stack([table.covariates[name][rows] for name in names])
    y, image = table.standardised[rows], table.image[rows]
    fold = rng.permutation(image.max() + 1)[image] % FOLDS
    importance, gains = np.zeros(len(names)), []
    for k in range(FOLDS):
        test = fold == k
        model = HistGradientBoostingRegressor(
            max_iter=80, learning_rate=0.1, max_leaf_nodes=16, random_state=0
        )
        model.fit(x[~test], y[~test])
        error = (y[test] - model.predict(x[test])) ** 2
        gain = y[test] ** 2 - error
        gains += [gain[image[test] == i].mean() for i in np.unique(image[test])]
        for j in range(len(names)):
            shuffled = x[test].copy()
            shuffled[:, j] = rng.permutation(shuffled[:, j])
            importance[j] += ((y[test] - model.predict(shuffled)) ** 2 - error).mean()
    if np.mean(gains) < 1.645 * np.std(gains) / np.sqrt(len(gains)):
        return Said()
    named = SPEAKS_FOR[names[int(np.argmax(importance))]]
    return Said(effects=named[:1], sets=(frozenset(named),))
