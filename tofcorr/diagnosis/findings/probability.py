r"""How probable every set of effects is, given the recording: the mathematics of naming.

A *model* m is the base model with a set of effects. It predicts each pose from all others. With the
sums of the poses, A_u and b_u, and the prior precision Lambda_m of its coefficients, the evidence
of some poses is a closed form,

.. math:: \log Z_m = \tfrac12\, b^\top (A + \Lambda_m)^{-1} b
    - \tfrac12 \log \det (A + \Lambda_m) + \mathrm{const},

and the log predictive density of pose u by all others is

.. math:: \ell_{mu} = \log Z_m(\text{all}) - \log Z_m(\text{all but } u) - \tfrac12 y_u^\top W y_u .

Four things keep its sum from being trusted as it stands, and each is a term of the probability:

- Poses depart from a model by more than pixel noise. All densities are divided by a *temperature*
  T: the variance of the poses' scores over what the model gives, for nine in ten of all effects.
- The poses that were recorded are a sample. Their weights w_u are drawn from the flat Dirichlet
  distribution (the Bayesian bootstrap; Rubin 1981), as in the averaging of Yao et al. (2018).
- The columns of an effect are not quite its form: no two lenses, rooms or robots are alike. What
  they explain of the true effect falls short by 1 + e^2 z^2, with its form error e and a standard
  normal z (a model discrepancy; Kennedy and O'Hagan 2001). So a model with gain g_k of effect k may
  explain up to e^2 z^2 s_k g_k more of what there is: at most as much as the best model n does.
  The form of k explains only what resembles it: s_k is the share that k takes away of what an
  effect l adds, the least of those l that the best model of all poses has and m has not.
- Few effects are there. Each has the prior odds o.

.. math:: p(m) = \Big\langle \operatorname{softmax}_m \Big[ |m| \log o
    + \min\big(D_m + \tfrac1T \textstyle\sum_k e_k^2 z_k^2 s_{mk} g_{mk},\; D_n\big) \Big]
    \Big\rangle_{w, z}, \qquad D_m = \tfrac1T \textstyle\sum_u w_u \ell_{mu} .

The prior standard deviation of an effect is a size a in metres, as a root mean square over all
pixels that the base model does not absorb; of four sizes the one that predicts best is taken.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import (
    LEAST_LEFT,
    FittedMap,
    Study,
    absorbed_share,
    signal,
    with_residual,
)
from tofcorr.simulation.effects import CATALOGUE

Model = tuple[str, ...]
"""The names of a model's effects, maps and probes among them, in alphabetical order."""

SIZES = (2.5e-4, 1e-3, 4e-3, 1.6e-2)
"""Prior standard deviations of an effect, metres: from what hardly matters to what no camera has
beyond. In steps of four: the evidence changes by less than half a nat between two of them."""
_MAGNIFIED = 5
"""What calibration absorbs of an effect magnifies its prior by this at most: nothing would
otherwise bound an effect of which hardly anything is seen. A prior."""


class Evidence:
    """Predicts each pose of a recording from all others, under any model.

    Args:
        study: The recording.
        beside: Effects that explain most of the gap as far as is known: a map of the image is
            estimated from what they leave.
    """

    def __init__(self, study: Study, beside: Sequence[str] = ()) -> None:
        self._study = study
        sums, base = study.sums.gls, study.sums.layout.base
        left = {name: 1 - absorbed_share(study, name) for name in sums.layout.effects}
        self.columns = {
            name: slice(low - base, high - base)
            for name, (low, high) in sums.layout.effects.items()
            if left[name] > LEAST_LEFT
        }
        pixels = study.sums.ols.scale * float(study.sums.count.sum())
        # The root mean square of each at one prior standard deviation, metres; see `SIZES`.
        self._unit = {
            name: (signal(study, name) * max(left[name], _MAGNIFIED**-2) / pixels) ** 0.5
            for name in self.columns
        }
        some = torch.cat([sums.total[None], sums.total - sums.gram])
        normal = some[:, :base, :base] + sums.layout.prior[:base, :base]
        self._factor = torch.linalg.cholesky(_regular(normal))
        self._base = _solved(self._factor, some[:, :base, base:])
        self.gram = some[:, base:, base:] - self._base.mT @ self._base
        residual = study.residual_of(beside, gls=True)
        self.maps = {n: FittedMap(study, e, residual) for n, e in study.maps.items()}
        self._studies = {"": study}
        self._given: dict[str, tuple[Tensor, Tensor, Tensor]] = {}

    def map_of(self, model: Iterable[str]) -> str:
        """Return the map of a model; empty where it has none."""
        return next((name for name in model if name in self.maps), "")

    def without_map_of(self, model: Iterable[str]) -> Study:
        """Return the study with a model's map subtracted, and poses as uncertain as before."""
        of_map = self.map_of(model)
        if of_map not in self._studies:
            residual = self._study.residual - self.maps[of_map].values
            self._studies[of_map] = with_residual(self._study, residual, None)
        return self._studies[of_map]

    def added(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """Return what each effect of a model adds that the base model does not absorb, metres.

        The root mean square over all pixels, fitted by likelihood beside the others.

        Args:
            sizes: As in `Beside`.
        """
        study, layout = self._study, self._study.sums.layout
        fitted = self.without_map_of(sizes).sums.gls
        names = self.with_columns(sizes)
        members, normal = layout.of(names), self._normal(sizes)
        theta = torch.linalg.solve(normal, fitted.score[:, members].sum(0))
        pixels, found = study.sums.ols.scale * float(study.sums.count.sum()), dict[str, float]()
        for name, (low, high) in layout.only(names).effects.items():
            own = torch.arange(*layout.effects[name])
            left = study.unabsorbed[own][:, own]
            found[name] = max(float(theta[low:high] @ left @ theta[low:high]) / pixels, 0.0) ** 0.5
        if of_map := self.map_of(sizes):
            share = study.fit.share
            square = (share * self.maps[of_map].values ** 2).sum() / share.sum()
            found[of_map] = float(square) ** 0.5
        return found

    def with_columns(self, model: Iterable[str]) -> list[str]:
        """Return the effects of a model that have columns, in their order."""
        return [name for name in self.columns if name in model]

    def precision(self, sizes: Mapping[str, float]) -> Tensor:
        """Return the prior precision of the coefficients of effects of some sizes, shape (K,)."""
        own = [torch.empty(0, dtype=torch.float64)]
        for name in self.with_columns(sizes):
            number = self.columns[name].stop - self.columns[name].start
            own.append(own[0].new_full((number,), (self._unit[name] / sizes[name]) ** 2))
        return torch.cat(own)

    def _normal(self, sizes: Mapping[str, float]) -> Tensor:
        """Return the normal matrix of the base model and of effects of some sizes, (K, K)."""
        sums, base = self._study.sums.gls, self._study.sums.layout.base
        members = sums.layout.of(self.with_columns(sizes))
        normal = sums.total[members][:, members]
        normal[:base, :base] += sums.layout.prior[:base, :base]
        normal.diagonal()[base:] += self.precision(sizes)
        return _regular(normal)

    def left_out_squares(self, model: Sequence[str]) -> Tensor:
        """Return the ordinary squares of each pose, predicted by all others, shape (U,), m^2."""
        study = self.without_map_of(model)
        return study.left_out_squares([name for name in model if name not in self.maps])

    def response(self, of_map: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return log evidence of the base model, scores of all effects beside it, and squares.

        The first two are of all poses and of all but one, shapes (1 + U,) and (1 + U, P); the last
        is y' W y of each pose, shape (U,).

        Args:
            of_map: Whose values are subtracted from the residual; empty: no map's.
        """
        if of_map not in self._given:
            sums = self.without_map_of([of_map]).sums
            score, base = sums.gls.score, sums.layout.base
            right = torch.cat([score.sum(0)[None], score.sum(0) - score])[..., None]
            inner = _solved(self._factor, right[:, :base])
            own = (right[:, base:] - self._base.mT @ inner)[..., 0]
            self._given[of_map] = _evidence(self._factor, inner), own, sums.gls.square
        return self._given[of_map]

    def temperature(self, sizes: Mapping[str, float]) -> float:
        """Return the variance of the poses' scores over that by the model, at least 1.

        It is that of nine in ten of the effects that are not in the model.

        Args:
            sizes: As in `Beside`.
        """
        sums, layout = self._study.sums.gls, self._study.sums.layout
        names = self.with_columns(sizes)
        members, total, known = layout.of(names), sums.total, self._normal(sizes)
        score = sums.score - sums.gram[:, :, members] @ torch.linalg.solve(
            known, sums.score.sum(0)[members]
        )
        beside = torch.linalg.solve(known, total[members])
        score = score - score[:, members] @ beside
        left = (total - total[:, members] @ beside).diagonal()
        ratios = []
        for name in self.columns:
            own = torch.arange(*layout.effects[name])
            own = own[left[own] > LEAST_LEFT * total.diagonal()[own]]
            if name not in names and len(own):
                ratios.append(float((score[:, own].square().sum(0) / left[own]).mean()))
        return max(1.0, float(torch.tensor(ratios or [1.0]).quantile(0.9)))


class Beside:
    """Predicts each pose of a recording from all others, with some effects and one more.

    Args:
        evidence: Of the recording.
        sizes: The prior standard deviation of each effect of the model, metres; that of a map is
            its own.
    """

    def __init__(self, evidence: Evidence, sizes: Mapping[str, float]) -> None:
        self._evidence, given = evidence, evidence.response(evidence.map_of(sizes))
        self._log_evidence, self._score, self._square = given
        own = [evidence.columns[name] for name in evidence.with_columns(sizes)]
        # The columns of no effect, for a model without one.
        own, gram = own or [slice(0)], evidence.gram
        rows = torch.cat([gram[:, each] for each in own], dim=1)
        normal = torch.cat([rows[:, :, each] for each in own], dim=2)
        factor = torch.linalg.cholesky(_regular(normal + evidence.precision(sizes).diag()))
        right = torch.cat([self._score[:, each] for each in own], dim=1)
        self._rows, self._inner = _solved(factor, rows), _solved(factor, right[..., None])
        self._log_evidence = self._log_evidence + _evidence(factor, self._inner)

    @property
    def density(self) -> Tensor:
        """The log predictive density of every pose by all others, shape (U,)."""
        return self._density(self._log_evidence)

    def density_with(self, name: str, size: float) -> Tensor:
        """Return the same with one more effect, shape (U,).

        Args:
            name: The effect.
            size: Its prior standard deviation, metres.
        """
        own = self._evidence.columns[name]
        rows, right = self._rows[:, :, own], self._score[:, own, None]
        gram = self._evidence.gram[:, own, own] - rows.mT @ rows
        prior = self._evidence.precision({name: size}).diag()
        factor = torch.linalg.cholesky(_regular(gram + prior))
        inner = _solved(factor, right - rows.mT @ self._inner)
        return self._density(self._log_evidence + _evidence(factor, inner))

    def _density(self, evidence: Tensor) -> Tensor:
        return evidence[0] - evidence[1:] - self._square / 2


def _solved(factor: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(factor, right, upper=False)


def _evidence(factor: Tensor, inner: Tensor) -> Tensor:
    """Return what columns add to the log evidence, by their factor and their scores over it."""
    return inner.square().sum((1, 2)) / 2 - factor.diagonal(dim1=1, dim2=2).log().sum(1)


def _regular(normal: Tensor) -> Tensor:
    """Return normal matrices that rounding cannot make singular."""
    ridge = 1e-10 * normal.diagonal(dim1=-2, dim2=-1) + TINY
    return normal + ridge.diag_embed()


@dataclass(frozen=True, kw_only=True)
class Models:
    """The models that were tried.

    Attributes:
        models: N of them.
        densities: Log predictive densities over that of the base model, over the temperature,
            shape (N, U).
        sizes: The prior size of each effect of each model.
        price: Minus the logarithm of the prior odds of an effect.
    """

    models: tuple[Model, ...]
    densities: Tensor
    sizes: tuple[Mapping[str, float], ...]
    price: float

    @property
    def effects(self) -> list[Model]:
        """Each model without its probes, which no catalogue has."""
        return [tuple(name for name in model if name in CATALOGUE) for model in self.models]

    @property
    def total(self) -> Tensor:
        """Log predictive density of all poses, shape (N,)."""
        return self.densities.sum(1)

    @property
    def _prices(self) -> Tensor:
        return self.price * torch.tensor([len(model) for model in self.models])

    def best(self) -> tuple[Model, Mapping[str, float]]:
        """Return the model of the highest posterior, before poses and forms are drawn."""
        at = int((self.total - self._prices).argmax())
        return self.models[at], self.sizes[at]

    def sizes_of(self, effects: Model) -> Mapping[str, float]:
        """Return the prior sizes of the best model with exactly these effects and any probes."""
        own = [model == effects for model in self.effects]
        level = torch.where(torch.tensor(own), self.total - self._prices, -torch.inf)
        return self.sizes[int(level.argmax())]

    def posterior(self, weights: Tensor, generator: torch.Generator) -> Tensor:
        """Return the probability of each model for some weights of the poses, shape (N, D).

        Args:
            weights: Of the poses, shape (D, U), with mean one.
            generator: Of the form errors, drawn for each row by itself.
        """
        density = self.densities @ weights.T
        drawn = torch.randn(self._missed.shape[1], len(weights), generator=generator).double()
        explained = torch.minimum(density + self._missed @ drawn.square(), density.max(0).values)
        return torch.softmax(explained - self._prices[:, None], 0)

    @cached_property
    def _missed(self) -> Tensor:
        """What the form of each effect may miss of the best model at z = 1, shape (N, K)."""
        names = sorted({name for model in self.models for name in model})
        total = dict(zip(map(frozenset, self.models), self.total.tolist(), strict=True))
        best, missed = max(total, key=total.__getitem__), torch.zeros(len(total), len(names))
        for row, model in zip(missed, total, strict=True):
            further = [one for one in best - model if model | {one} in total]
            added = {one: total[model | {one}] - total[model] for one in further}
            for name in model & CATALOGUE.keys():
                rest, alike = model - {name}, 1.0
                for one, beside in added.items():
                    alone = total.get(rest | {one}, 0.0) - total.get(rest, math.inf)
                    alike = min(alike, max(1 - beside / alone, 0.0)) if alone > 0 else alike
                gain = max(total[model] - total.get(rest, total[model]), 0.0)
                row[names.index(name)] = CATALOGUE[name].form_error ** 2 * alike * gain
        return missed.double()


class Search:
    """Tries models of one effect, then with one more as long as the best becomes more probable.

    Args:
        evidence: Of the recording.
        odds: Prior odds of an effect.
        most: How many effects a model may have.
        width: How many of the best models of one size are enlarged.
    """

    def __init__(self, evidence: Evidence, odds: float, most: int, width: int = 5) -> None:
        self._evidence, self._most, self._width = evidence, most, width
        self._price = -math.log(odds)
        self._tried: dict[Model, tuple[float, dict[str, float], Tensor]] = {}
        self._enlarged: set[Model] = set()
        for of_map in ("", *evidence.maps):
            self._grow({of_map: math.nan} if of_map else {})

    def best(self) -> dict[str, float]:
        """Return the sizes of the effects of the most probable model."""
        return max(self._tried.values(), key=lambda one: one[0])[1]

    def models(self) -> Models:
        """Return all models tried, and their densities at the temperature of the best.

        Before, every effect of the best model is replaced by every other, so that each that may be
        there in its place is judged.
        """
        evidence, best = self._evidence, self.best()
        for name in best:
            rest = {other: size for other, size in best.items() if other != name}
            self._enlarge(rest)
            for of_map in evidence.maps if evidence.maps.keys().isdisjoint(rest) else ():
                self._keep({**rest, of_map: math.nan})
        densities = torch.stack([density for _, _, density in self._tried.values()])
        return Models(
            models=tuple(self._tried),
            densities=(densities - self._base) / evidence.temperature(best),
            sizes=tuple(sizes for _, sizes, _ in self._tried.values()),
            price=self._price,
        )

    def _grow(self, start: dict[str, float]) -> None:
        """Add effects to a model of none, or of one map."""
        beam, top = [start], self._keep(start)
        if top < -2 * self._price:  # A map that predicts worse than none.
            return
        for count in range(1, self._most + 1):
            for sizes in beam:
                self._enlarge(sizes)
            grown = [
                (level, sizes)
                for level, sizes, _ in self._tried.values()
                if len(sizes) == len(start) + count and start.keys() <= sizes.keys()
            ]
            grown.sort(key=lambda one: -one[0])
            # A pair is tried even where neither of both is probable alone.
            if not grown or (grown[0][0] <= top and count > 1):
                break
            beam, top = [sizes for _, sizes in grown[: self._width]], max(grown[0][0], top)

    def _enlarge(self, sizes: dict[str, float]) -> None:
        """Try a model with each effect more, at the size that predicts best where it is alone."""
        model = tuple(sorted(sizes))
        if model in self._enlarged:
            return
        self._enlarged.add(model)
        beside = Beside(self._evidence, sizes)
        for name in self._evidence.columns:
            if name not in sizes:
                alone = self._tried.get((name,))
                for size in SIZES if alone is None else (alone[1][name],):
                    self._keep({**sizes, name: size}, beside.density_with(name, size))

    def _keep(self, sizes: dict[str, float], density: Tensor | None = None) -> float:
        """Remember a model, and return its log posterior over that of the base model."""
        if density is None:
            density = Beside(self._evidence, sizes).density
        if not sizes:
            self._base = density
        model = tuple(sorted(sizes))
        level = float((density - self._base).sum()) - self._price * len(model)
        if model not in self._tried or level > self._tried[model][0]:
            self._tried[model] = level, sizes, density
        return self._tried[model][0]
