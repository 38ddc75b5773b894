r"""Which of the simulator's own parameters need no change.

Hand-eye transform and base terms can stand in for one another, and for what an effect's model
misses: a constant is nearly a shift of the camera along its axis. Fitted freely, a parameter of the
simulator that is right takes up part of another cause. The simulator as given is the null
hypothesis: a parameter changes only if the change closes at least a stated mean square.

With normal equations A, b around the base fit, where the parameters of the simulator as given are
at -s, the fit that holds the columns H has

.. math:: \delta_H = -s_H, \qquad A_{FF}\,\delta_F = b_F + A_{FH}\, s_H ,

and its sum of squares exceeds that of the free fit d0, with covariance C = A^-1, by

.. math:: (s + \delta_0)_H^T \, C_{HH}^{-1} \, (s + \delta_0)_H .
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


def held_solution(normal: Tensor, score: Tensor, start: Tensor, held: Sequence[int]) -> Tensor:
    """Fit all columns but those held; return how far each is from the simulator's, shape (K,).

    Args:
        normal: Sum of A_u and prior precision, shape (K, K).
        score: Sum of b_u, shape (K,).
        start: From the simulator to the base fit, shape (K,).
        held: Numbers of the columns that stay as the simulator has them.
    """
    free = torch.ones(len(start), dtype=torch.bool)
    free[list(held)] = False
    own = normal[free]
    found = torch.zeros_like(start)
    right = score[free] + own[:, ~free] @ start[~free]
    found[free] = start[free] + torch.linalg.solve(own[:, free], right)
    return found


def unchanged(
    normal: Tensor,
    score: Tensor,
    start: Tensor,
    groups: Mapping[str, Sequence[int]],
    least: Mapping[str, float],
) -> frozenset[str]:
    """Return the parameters that need no change: one by one, the least needed first.

    Args:
        normal: Sum of A_u and prior precision, shape (K, K).
        score: Sum of b_u, shape (K,).
        start: From the simulator to the base fit, shape (K,).
        groups: Columns of each parameter that may stay as it is.
        least: What a change of each must close, in the unit of `normal`.
    """
    if not groups:
        return frozenset()
    best, covariance = held_solution(normal, score, start, ()), torch.linalg.inv(normal)

    def excess(columns: Sequence[int]) -> float:
        own = torch.tensor(columns, dtype=torch.int64)
        return float(best[own] @ torch.linalg.solve(covariance[own][:, own], best[own]))

    held: list[str] = []
    columns: list[int] = []
    while len(held) < len(groups):
        base = excess(columns)
        needed = {
            name: (excess([*columns, *own]) - base) / least[name]
            for name, own in groups.items()
            if name not in held
        }
        name = min(needed, key=lambda each: needed[each])
        if needed[name] >= 1:
            break
        held.append(name)
        columns += groups[name]
    return frozenset(held)
