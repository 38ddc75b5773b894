"""A recording under diagnosis: pixels, base fit, candidate effects, their columns and sums.

Effects of the catalogue that the recording can test may be added to the base model, and probes:
patterns of effects that the catalogue does not contain. A probe is never reported as a cause. Where
one explains what no effect of the catalogue explains, the cause is unknown, and the probe describes
its pattern.

Calibration, estimated planes and other effects absorb a share of an effect. What planes absorb is
said by name, and not judged where hardly anything remains.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base import BaseFit, unknown_amplitude_columns
from tofcorr.diagnosis.sums.linear_system import (
    BASE,
    OLS_SD,
    PoseSums,
    draw_folds,
    pose_columns,
    pose_sums,
)
from tofcorr.diagnosis.sums.observations import TINY, Observations
from tofcorr.geometry.rays import phase_from_radial_distance
from tofcorr.geometry.se3 import by_frame
from tofcorr.pixels.dataset import in_threads
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.base import MEASURED_PLANES, EffectInputs

# Prior standard deviation of a probe, metres. Chosen.
_SIZE = 0.01


@dataclass(frozen=True)
class Probe:
    """One pattern.

    Attributes:
        trace: What it looks like: a clause that follows "It".
        scaled_columns: Computes its columns, (M, K), metres at one prior standard deviation.
    """

    trace: str
    scaled_columns: Callable[[EffectInputs], Tensor]


def probes_for(inputs: EffectInputs) -> dict[str, Probe]:
    """Return the probes that a recording allows."""
    found = {
        "frame_period": Probe("repeats every few frames", _frame_period),
        "image_shape": Probe("has one shape in every image, finer than the pixel effect", _map),
        "any_smooth": Probe("varies smoothly with distance, angle, place and amplitude", _smooth),
        "any_time": Probe("changes slowly with time", _slow),
    }
    if len(inputs.facts.timestamp) > 2:
        found["previous_frame"] = Probe("depends on the previous frame", _previous_frame)
    return found


def _frame_period(inputs: EffectInputs) -> Tensor:
    """Return waves over 2 to 5 frames: cycles of exposures and modulation frequencies."""
    number = torch.arange(len(inputs.facts.timestamp), dtype=torch.float64)
    turns = [2 * torch.pi * number / period for period in (2, 3, 4, 5)]
    waves = [wave(turn) for turn in turns for wave in (torch.cos, torch.sin)]
    # The sine of every second frame is zero.
    return inputs.of_frame(_SIZE * torch.stack([waves[0], *waves[2:]], dim=-1))


def _map(inputs: EffectInputs) -> Tensor:
    """Return products of cosines over the image, up to nine half waves, shape (M, K).

    Short waves have smaller priors, so that the probe is smooth.
    """
    # Each pixel once, however many frames show it.
    used, number = inputs.pixel.unique(return_inverse=True)
    height, width = inputs.camera.height, inputs.camera.width
    places = (used % width) / max(width - 1, 1), (used // width) / max(height - 1, 1)
    of_x, of_y = ([torch.cos(torch.pi * i * at.double()) for i in range(9)] for at in places)
    columns = [
        _SIZE / (1 + 3 * (i + j) / 10) * of_x[i] * of_y[j]
        for i, j in product(range(9), repeat=2)
        if 0 < i + j <= 9
    ]
    return torch.stack(columns, dim=-1)[number]


def _smooth(inputs: EffectInputs) -> Tensor:
    """Return forty random waves over all that is known of a pixel, shape (M, 40).

    They span a Gaussian process of unknown form (random Fourier features; Rahimi and Recht 2007),
    whose length is about one standard deviation of each quantity. The draws are always the same.
    """
    known = [inputs.radial_distance, inputs.rows, inputs.columns]
    known.append(1 / inputs.incidence_cosine.clamp(min=0.2))
    if inputs.amplitude_images is not None:
        amplitude = inputs.known_amplitude
        known.append(amplitude.clamp(min=1e-3 * float(amplitude.median())).log())
    scaled = torch.stack([(own - own.mean()) / own.std().clamp(min=TINY) for own in known], dim=1)
    generator = torch.Generator().manual_seed(0)
    turns = 0.8 * torch.randn(len(known), 40, generator=generator).double()
    starts = 2 * torch.pi * torch.rand(40, generator=generator).double()
    return _SIZE * 20**-0.5 * torch.cos(scaled.double().clamp(-3, 3) @ turns + starts)


def _slow(inputs: EffectInputs) -> Tensor:
    """Return six cosines over the time of the recording, up to three periods, shape (M, 6)."""
    time = inputs.facts.timestamp.double()
    share = (time - time.min()) / (time.max() - time.min()).clamp(min=TINY)
    waves = [torch.cos(torch.pi * count * share) for count in range(1, 7)]
    return inputs.of_frame(_SIZE * torch.stack(waves, dim=-1))


def _previous_frame(inputs: EffectInputs) -> Tensor:
    """Return the change since the previous frame, and the error by a tenth of its signal, metres.

    That is added to the pixel's own. Ratios of amplitudes are clamped, so that dark pixels do not
    dominate.
    """
    before = (inputs.frame - 1).clamp(min=0)
    assert inputs.distance_images is not None
    distance = inputs.distance_images.flatten(1)[before, inputs.pixel].double()
    seen = (distance > 0) & (inputs.frame > 0)
    columns = [torch.where(seen, distance - inputs.radial_distance, 0.0) / 20]
    if inputs.amplitude_images is not None and inputs.modulation_frequency is not None:
        amplitude = inputs.amplitude_images.flatten(1)[before, inputs.pixel].double()
        share = torch.where(seen, amplitude, 0.0) / inputs.known_amplitude.clamp(min=TINY)
        phase = phase_from_radial_distance(distance, inputs.known_frequency) - inputs.phase
        share = share.clamp(max=20) * torch.sin(phase)
        columns.append(inputs.metres_per_radian / 10 * share)
    return torch.stack(columns, dim=-1)


@dataclass(frozen=True, kw_only=True)
class Study:
    """A recording under diagnosis. Functions that change the model return another study.

    Attributes:
        options: Of the diagnosis.
        observations: The chosen pixels.
        fit: The base model, fitted.
        inputs: What effects may depend on.
        effects: Effects with columns that may be added to the base model, by name.
        maps: Effects with one value a cell of the image, likewise.
        probes: Patterns that no effect of the catalogue makes, with columns, likewise.
        missing: Untestable effects and their missing inputs.
        columns: Of the base model (`BASE`), metres per unit coefficient, and of effects and probes
            by name, metres at one standard deviation of the prior, shape (M, K) each. They are
            never copied into one matrix of all pixels.
        pose: Columns of an uncertain pose, shape (M, 3).
        residual: Of the base fit less the maps already subtracted, shape (M,), metres; where
            effects are linearised at coefficients c, with J c less what they add.
        straight: The same without that, shape (M,), metres.
        sums: Sums of products of these over the pixels of every pose.
        folds: Which poses each fold of the cross-validation holds out, shape (folds, U), float64.
        signs: Sign flips of the poses, shape (B, U).
        pattern: The base model's fixed pattern, estimated; None if it has none.
    """

    options: DiagnosisOptions
    observations: Observations
    fit: BaseFit
    inputs: EffectInputs
    effects: Mapping[str, CatalogueEffect]
    maps: Mapping[str, MapEffect]
    probes: Mapping[str, Probe]
    missing: Mapping[str, list[str]]
    columns: Mapping[str, Tensor]
    pose: Tensor
    residual: Tensor
    straight: Tensor
    sums: PoseSums
    folds: Tensor
    signs: Tensor
    pattern: MapEffect | None = None

    @cached_property
    def weight(self) -> Tensor:
        """Inverse variance of each pixel, with its robust weight, shape (M,), 1 / m^2."""
        return self.fit.trust / (self.sums.dispersion * self.fit.sigma**2)

    @property
    def material_mm(self) -> float:
        """Minimum size of the first effect that is named, millimetres.

        A simulator's error that was fitted at other poses is carried to these with a form error,
        and planes that were found in the depth took pixels at their edges for their own. What the
        tolerance for finer forms of base terms allows is then no effect either.
        """
        tests, known = self.options.tests, self.fit.known
        if not self.inputs.planes_are_measured or (known is not None and known.carried):
            return max(tests.material_mm, tests.form_tolerance_mm)
        return tests.material_mm

    @cached_property
    def unit_of_pixel(self) -> Tensor:
        """Pose of every pixel, shape (M,), int64."""
        return self.observations.unit[self.observations.frame]

    def columns_of(self, names: Sequence[str]) -> list[Tensor]:
        """Return the columns of the base model and of some effects."""
        return [self.columns[BASE], *(self.columns[name] for name in names)]

    @cached_property
    def unabsorbed(self) -> Tensor:
        """Gram matrix of all columns after regression on the base model, ordinary, (P, P)."""
        gram, layout = self.sums.ols.total, self.sums.layout
        base = torch.arange(layout.base)
        return left_over(gram, base, torch.arange(len(gram)), layout.prior_of(base))

    def times(self, names: Sequence[str], coefficients: Tensor) -> Tensor:
        """Return what base model and some effects predict with coefficients (K,), (M,), metres."""
        parts = self.columns_of(names)
        own = coefficients.split([part.shape[1] for part in parts])
        return torch.stack([x @ theta for x, theta in zip(parts, own, strict=True)]).sum(0)

    def residual_of(self, names: Sequence[str], *, gls: bool = False) -> Tensor:
        """Return the residual of base model and effects fitted to all poses, shape (M,), metres.

        Args:
            names: The effects.
            gls: Whether to fit by likelihood. Where poses scatter, an ordinary fit bends the model
                towards their offsets, and leaves the same bend in every image.
        """
        sums = self.sums.gls if gls else self.sums.ols
        return self.residual - self.times(names, sums.solve(names))

    def left_out_squares(self, names: Sequence[str]) -> Tensor:
        """Return the ordinary sum of squares of each pose, predicted by all others, (U,), m^2."""
        return self.sums.ols.squares_at(names, self.sums.ols.left_out_coefficients(names))

    def left_out_mean_square(self, names: Sequence[str]) -> float:
        """Return the mean of `left_out_squares` over all pixels, m^2."""
        return float(self.left_out_squares(names).sum() / self.sums.count.sum())

    def pose_equations(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Return the normal equations of each pose's offset and tilts, (U, 3, 3) and (U, 3)."""
        both = torch.cat([self.pose, residual[:, None]], dim=1)
        sums = self.observations.products(self.pose * self.weight[:, None], both)
        return sums[..., :-1], sums[..., -1]

    def pose_surface(self, own: Tensor) -> Tensor:
        """Return what offsets and tilts (U, 3) add to each pixel's distance, (M,), metres."""
        of_frame = own[self.observations.unit][:, :, None]
        return by_frame(self.pose, of_frame, self.observations.frame)[:, 0]


def build_study(
    options: DiagnosisOptions, observations: Observations, fit: BaseFit, inputs: EffectInputs
) -> Study:
    """Sum up the columns of base model and candidates; draw folds and sign flips."""
    tests, num_units = options.tests, observations.num_units
    generator = torch.Generator().manual_seed(options.seed)
    folds = draw_folds(num_units, tests.folds, generator)
    flips = torch.randint(0, 2, (tests.flips, num_units), generator=generator)
    wanted = options.catalogue if options.catalogue is not None else tuple(CATALOGUE)
    kinds = {name: CATALOGUE[name] for name in wanted if name not in options.leave_out}
    missing = {name: wants for name, kind in kinds.items() if (wants := kind.missing(inputs))}
    known = {n: kind.for_recording(inputs) for n, kind in kinds.items() if n not in missing}
    maps = {name: each for name, each in known.items() if isinstance(each, MapEffect)}
    probes, pose = probes_for(inputs), pose_columns(inputs)
    sources = [(name, each) for name, each in known.items() if name not in maps]
    sources += list(probes.items())
    found = in_threads(lambda source: source[1].scaled_columns(inputs), sources)
    effects = {name: form for name, form in sources if isinstance(form, CatalogueEffect)}
    # What is uncertain of the simulator's own error, or stands in for the amplitude.
    further = [] if fit.known is None else [fit.known.uncertain]
    further.append(unknown_amplitude_columns(observations, inputs))
    # The ordinary weights of a pose add up to one value with a variance of OLS_SD^2.
    prior = fit.model.prior_precision(num_units / OLS_SD**2)
    prior = torch.block_diag(prior, torch.eye(sum(own.shape[1] for own in further)).double())
    base = torch.cat([fit.model.linearised(fit.tool_from_camera)[1], *further], dim=1)

    columns = {BASE: base, **dict(zip([name for name, _ in sources], found, strict=True))}
    return Study(
        options=options,
        observations=observations,
        fit=fit,
        inputs=inputs,
        effects=effects,
        maps=maps,
        probes=probes,
        missing=missing,
        columns=columns,
        pose=pose,
        residual=fit.residual,
        straight=fit.residual,
        sums=pose_sums(observations, columns, pose, fit, prior).with_pose_uncertainty(),
        folds=folds,
        signs=2.0 * flips.double() - 1.0,
    )


def with_poses_reestimated(study: Study, names: Sequence[str]) -> Study:
    """Return the study whose pose uncertainty is estimated with these effects in the model."""
    known = [name for name in names if name in study.sums.layout.effects]
    return replace(study, sums=study.sums.with_pose_uncertainty(known))


def with_residual(
    study: Study,
    residual: Tensor,
    names: Sequence[str] | None = (),
    changed: Mapping[str, Tensor] | None = None,
) -> Study:
    """Return the study of another residual, and of other columns; unchanged products are kept.

    Args:
        study: Before.
        residual: The new one, shape (M,), metres.
        names: Effects of the model whose residual the uncertainty of the poses is estimated from;
            None: it is kept.
        changed: The columns of effects that differ, shape (M, E) each; None: all are the same.
    """
    changed, before = changed or {}, study.sums
    columns = {**study.columns, **changed}
    all_spans = {BASE: (0, before.layout.base), **before.layout.effects}
    spans = [all_spans[name] for name in changed]
    places = torch.cat([*(torch.arange(*span) for span in spans), torch.tensor([-1])])
    new = torch.cat([*changed.values(), residual[:, None]], dim=1)
    # One pass over the columns gives both sums.
    right = torch.cat([own[:, None] * new for own in (study.fit.weight, study.fit.share)], dim=1)
    parts = [*columns.values(), study.pose, residual[:, None]]
    products = torch.cat([study.observations.products(part, right) for part in parts], dim=1)
    weighted, plain = before.weighted.clone(), before.plain.clone()
    for sums, own in zip((weighted, plain), products.chunk(2, dim=-1), strict=True):
        sums[:, :, places] = own
        sums[:, places, :] = own.mT
    sums = replace(before, weighted=weighted, plain=plain)
    sums = sums if names is None else sums.with_pose_uncertainty(names)
    return replace(study, columns=columns, residual=residual, sums=sums)


def without_map(study: Study, values: Tensor, spent: Collection[str]) -> Study:
    """Return the study with a map subtracted.

    Args:
        study: Before.
        values: The map's value in each pixel, shape (M,), metres.
        spent: Maps that are candidates no longer.
    """
    maps = {name: m for name, m in study.maps.items() if name not in spent}
    left = with_residual(study, study.residual - values)
    return replace(left, maps=maps, straight=study.straight - values)


LEAST_LEFT = 1e-3
"""If calibration leaves less than this share of an effect, nothing is said of what is left: it is
rounding error. Chosen."""


def absorbed_share(study: Study, name: str) -> float:
    """Return the share of an effect's signal that the base model absorbs.

    The share is averaged over the effect's prior. 1 means that nothing of it can be observed.
    """
    total, own = signal(study, name), slice(*study.sums.layout.effects[name])
    left = float(study.unabsorbed.diagonal()[own].sum())
    return float(np.clip(1.0 - left / total, 0.0, 1.0)) if total > 0 else 1.0


def hidden_effects(study: Study, *, absorbed: float = 0.97) -> list[str]:
    """Return the effects that look like the hand-eye transform and the base model.

    Args:
        study: The recording.
        absorbed: From this share on, that calibration absorbs, another recording is needed. Chosen.
    """
    return [name for name in study.effects if absorbed_share(study, name) > absorbed]


def signal(study: Study, name: str) -> float:
    """Return the sum of an effect's squares, averaged over its prior."""
    low, high = study.sums.layout.effects[name]
    return float(study.sums.ols.total.diagonal()[low:high].sum())


def left_over(gram: Tensor, members: Tensor, own: Tensor, prior: Tensor) -> Tensor:
    """Return the Gram matrix of an effect after regression on other columns, a Schur complement.

    Args:
        gram: Of all columns, one or many, shape (..., P, P).
        members: Numbers of the other columns, shape (K,).
        own: Numbers of the effect's columns, shape (E,).
        prior: Prior precision of the other coefficients, shape (K, K).
    """
    inner, cross = gram[..., members[:, None], members] + prior, gram[..., members[:, None], own]
    return gram[..., own[:, None], own] - cross.mT @ torch.linalg.solve(inner, cross)


def fitted_coefficients(study: Study, chosen: Sequence[str]) -> dict[str, Tensor]:
    """Return the coefficients of chosen effects in their own units, by name."""
    known = [name for name in chosen if name in study.effects]
    theta, effects = study.sums.ols.solve(known), study.effects
    parts = theta[study.sums.layout.base :].split([len(effects[n].coefficients) for n in known])
    return {n: own * effects[n].prior_sd() for n, own in zip(known, parts, strict=True)}


def without_absorbed(study: Study) -> tuple[Study, list[str]]:
    """Return the study without the effects that estimated planes absorb, and a warning.

    An effect is not judged if estimated planes leave less than a twentieth of what measured planes
    would: so much looks like others. It is among `missing`, and needs measured planes. Above a half
    a warning names the effect: its smallest detectable size has grown by a factor of 1.4. A study
    of measured planes stays as it is.
    """
    if not study.observations.num_walls:
        return study, []
    shares = {name: absorbed_by_planes(study, name) for name in study.effects}
    hidden = {n: [MEASURED_PLANES.words] for n, share in shares.items() if 20 * (1 - share) < 1}
    if hidden:
        effects = {name: effect for name, effect in study.effects.items() if name not in hidden}
        kept = [*effects, *study.probes]
        study = replace(
            study,
            effects=effects,
            missing={**study.missing, **hidden},
            columns={name: study.columns[name] for name in (BASE, *kept)},
            sums=study.sums.of(kept).with_pose_uncertainty(),
        )
    partly = [
        f"{name} ({100 * share:.0f} %)"
        for name, share in shares.items()
        if share > 0.5 and name not in hidden
    ]
    count, missing = study.observations.num_walls, study.missing
    unjudged = [name for name, wants in missing.items() if MEASURED_PLANES.words in wants]
    planes = "plane of 1 wall is" if count == 1 else f"planes of {count} walls are"
    sentence = f"The {planes} estimated together with the base model (recording.yaml: planes)."
    if unjudged:
        sentence += f" Not judged, because measured planes are needed: {', '.join(unjudged)}."
    if partly:
        sentence += f" Estimated planes absorb a large share of {', '.join(partly)}."
    return study, [sentence]


def absorbed_by_planes(study: Study, name: str) -> float:
    """Return the share that estimated planes absorb of what measured planes would leave."""
    model, everything = study.fit.model, torch.arange(study.sums.layout.base)
    planes = (everything >= model.num_hand_eye) & (everything < model.num_geometry)
    kept, layout, gram = everything[~planes], study.sums.layout, study.sums.ols.total
    own = torch.arange(*layout.effects[name])
    measured = float(left_over(gram, kept, own, layout.prior_of(kept)).trace())
    if measured <= LEAST_LEFT * signal(study, name):
        return 0.0
    return 1.0 - float(study.unabsorbed.diagonal()[own].sum()) / measured


class FittedMap:
    r"""An effect of one value for each cell of the image, fitted to what a model leaves.

    Such values are no columns. With the residual r, less the offset and tilts of its pose, and the
    weights w of the pixels of a cell c, the value is

    .. math:: v_c = \frac{\sum w r}{\sum w + s^{-2}} ,

    with the prior standard deviation s, which is no less than what poses agree in. The weights are
    those of the pixels' own noise. The dispersion says how much more sums over many pixels vary
    than independent noise would make them, where neighbours share noise or show a smooth pattern; a
    cell is no such sum.

    Args:
        study: The recording.
        effect: Which map.
        residual: Of the model so far, shape (M,), metres.
        prior_sd: Prior standard deviation of the values, metres; None: what poses agree in.
        least_sd: What is taken at least then, metres: the size of fixed patterns.

    Attributes:
        prior_sd: The one that was taken, metres.
    """

    def __init__(
        self,
        study: Study,
        effect: MapEffect,
        residual: Tensor,
        prior_sd: float | None = None,
        least_sd: float = 0.003,
    ) -> None:
        self._study, self._effect = study, effect
        # Of large images few cells hold a chosen pixel.
        self._used, self._cells = effect.cells_of(study.inputs.pixel).unique(return_inverse=True)
        # The most probable offset and tilts of each pose are taken off.
        inner, score = study.pose_equations(residual)
        pose = torch.linalg.solve(inner + torch.diag(study.sums.pose_sd**-2), score)
        self._observed = residual - study.pose_surface(pose)
        self._sums = self._per_pose(self._cells, study.fit.weight * self._observed)
        self.prior_sd = max(self._agreed(), least_sd) if prior_sd is None else prior_sd

    def _per_pose(self, cells: Tensor, values: Tensor) -> Tensor:
        """Return the sum of values (M,) in each of some cells (M, C) and pose, (U, cells)."""
        sums = torch.zeros(self._study.sums.num_units, len(self._used), dtype=torch.float64)
        for group in cells.unbind(1):
            sums.index_put_((self._study.unit_of_pixel, group), values, accumulate=True)
        return sums

    def _agreed(self) -> float:
        """Return the root mean square of what poses agree in, cell by cell, metres.

        The noise of two poses is independent, so that the products of different poses estimate it.
        """
        weight, square = self._study.fit.weight, 0.0
        for group in self._cells.split(1, dim=1):
            own, seen = (self._per_pose(group, x) for x in (weight * self._observed, weight))
            products, pairs = (float((x.sum(0) ** 2 - (x**2).sum(0)).sum()) for x in (own, seen))
            if pairs > 0:
                square = max(square, products / pairs)
        return square**0.5

    @cached_property
    def _systems(self) -> Tensor:
        """Each fold's normal matrix, (folds, cells, cells), or its diagonal (folds, cells).

        Where a pixel lies in one cell only, the matrix is diagonal.
        """
        size, weight = [len(self._used)] * self._cells.shape[1], self._study.fit.weight
        systems = torch.zeros(len(self._study.folds), *size, dtype=torch.float64)
        for places in product(self._cells.unbind(1), repeat=len(size)):
            systems.index_put_((self._fold, *places), weight, accumulate=True)
        return systems

    @property
    def _fold(self) -> Tensor:
        """The fold that holds out each pixel, shape (M,)."""
        return self._study.folds.argmax(0)[self._study.unit_of_pixel]

    def _solved(self, system: Tensor, right: Tensor) -> Tensor:
        """Return the values of a right side (cells,)."""
        prior = self.prior_sd**-2
        if system.ndim == 1:
            return right / (system + prior)
        return torch.linalg.solve(system + prior * torch.eye(len(system)).double(), right)

    def whole(self) -> Tensor:
        """Return the map's values estimated from all poses, shape (cells,), metres."""
        found = self._solved(self._systems.sum(0), self._sums.sum(0))
        every = torch.zeros(len(self._effect.coefficients), dtype=torch.float64)
        return every.index_copy(0, self._used, found)

    @cached_property
    def values(self) -> Tensor:
        """The map's value in every pixel, estimated without the pixel's fold, (M,), metres."""
        kept, whole = (1 - self._study.folds) @ self._sums, self._systems.sum(0)
        pairs = zip(self._systems, kept, strict=True)
        of_folds = torch.stack([self._solved(whole - own, right) for own, right in pairs])
        return of_folds[self._fold[:, None], self._cells].sum(-1)
