"""Forward selection of effect columns by Schwarz's criterion, pixels taken as independent."""

import numpy as np

from benchmarks.withheld.baselines.covariates import Table
from benchmarks.withheld.fitting import solve
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.outcomes import Said

MOST = 4
BAND = 2 * np.pi / 1.25  # 1/m, the fourth harmonic near 30 MHz


def bayes_information(table: Table, rng: np.random.Generator) -> Said:
    """Add the group of columns that lowers n log(RSS/n) + k log n most, until none lowers it."""
    del rng
    groups = _groups(table)
    weight = np.sqrt(table.problem.weight)
    base = table.problem.columns
    stacked = np.column_stack(
        [base, *(columns for columns, _ in groups.values()), table.problem.target]
    )
    stacked = stacked * weight[:, None]
    gram = stacked.T @ stacked
    places, start = {}, base.shape[1]
    for name, (columns, _) in groups.items():
        places[name] = np.arange(start, start + columns.shape[1])
        start += columns.shape[1]
    n, chosen, named = len(stacked), np.arange(base.shape[1]), []

    def criterion(keep: np.ndarray, extra: int) -> float:
        theta = solve(gram[np.ix_(keep, keep)], gram[keep, -1])
        rest = gram[-1, -1] - gram[keep, -1] @ theta
        return n * np.log(max(rest, 1e-30) / n) + (len(keep) + extra) * np.log(n)

    extra, best = 0, criterion(chosen, 0)
    while len(named) < MOST:
        tried = {
            name: criterion(np.append(chosen, place), extra + groups[name][1])
            for name, place in places.items()
            if name not in named
        }
        name = min(tried, key=tried.__getitem__)
        if tried[name] >= best:
            break
        best, extra = tried[name], extra + groups[name][1]
        chosen = np.append(chosen, places[name])
        named.append(name)
    return Said(effects=tuple(named), sets=tuple(frozenset({name}) for name in named))


def _groups(table: Table) -> dict[str, tuple[Array, int]]:
    """Columns (M, K) of each effect, and how many parameters went into them besides."""
    c = table.covariates
    d, cosine = c["distance"], c["cosine"]
    x, y = c["target x"] - c["target x"].mean(), c["target y"] - c["target y"].mean()
    pixels = int(table.pixel.max()) + 1
    groups: dict[str, tuple[list[Array], int]] = {
        "wiggling": (
            [np.sin(BAND * d), np.cos(BAND * d), np.sin(2 * BAND * d), np.cos(2 * BAND * d)],
            0,
        ),
        "warm_up": ([np.exp(-c["time"] / 200), np.exp(-c["time"] / 1000)], 0),
        "incidence_angle": ([1 / cosine], 0),
        "multipath": ([np.exp(x), np.exp(-x), np.exp(y), np.exp(-y)], 0),
        "lens": (
            [d * c["slope across"], d * c["slope along"], c["slope across"], c["slope along"]],
            0,
        ),
        "target_shape": ([f / cosine for f in (x * x, x * y, y * y, x**3, y**3)], 0),
        "target_registration": ([1 / cosine, x / cosine, y / cosine], 0),
        "robot_kinematics": ([c[f"tool {axis}"] / cosine for axis in "xyz"], 0),
        "motion": ([c["speed"], c["speed"] * np.sin(BAND * d / 2)], 0),
        "timestamp_offset": ([c["speed"] / cosine], 0),
        "fixed_pattern": ([c["pixel"]], pixels),
        "row_column_pattern": (
            [_line_mean(table, "row"), _line_mean(table, "column")],
            int(2 * np.sqrt(pixels)),
        ),
    }
    if "amplitude" in c:
        a = np.exp(c["amplitude"] - np.median(c["amplitude"]))
        groups |= {
            "amplitude": ([c["amplitude"], a**-0.5], 0),
            "saturation": ([c["brightest"], c["brightest"] * np.sin(BAND * d)], 0),
            "mixed_pixels": ([c["edge"], c["edge"] ** 2], 0),
            "stray_light": ([c["surroundings"], c["surroundings"] * d], 0),
        }
    logged = {
        "integration_time": ("integration time", np.log),
        "room_temperature": ("room temperature", np.asarray),
        "ambient_light": ("ambient share", np.asarray),
    }
    groups |= {
        name: ([function(c[key])], 0) for name, (key, function) in logged.items() if key in c
    }
    return {name: (np.column_stack(columns), more) for name, (columns, more) in groups.items()}


def _line_mean(table: Table, line: str) -> Array:
    """Mean residual of the same row or column, the pixel itself left out."""
    index = table.covariates[line].astype(int)
    total, count = np.bincount(index, table.residual), np.bincount(index)
    return (total[index] - table.residual) / np.maximum(count[index] - 1, 1)
