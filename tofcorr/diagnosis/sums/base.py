r"""The base model: hand-eye transform, estimated walls, constant and error terms; and its fit.

Where no amplitude was recorded, an error that depends on it would pass for another effect:
wiggling, incidence, pixel, lens. The amplitude of a uniform target follows from geometry and
exposure,

.. math:: b = \tau \cos\theta / D^2 ,

up to its reflectivity and the vignetting. The columns b, b^2 and b r^2, for each target, with r the
distance from the image centre, are therefore part of the base model. What looks like them is not
named. What differs within a target, as between the squares of a checkerboard, stays in the
residual.

The fit is robust and in the forward form, from several starts. A simulator under diagnosis already
makes an error; it is split from the geometry and known to the fit. Where a camera filters its
images and neighbours share noise, effects that mix neighbouring pixels of measured images would
explain the noise of the very pixel whose error is to be explained: they look at images without it.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.noise import (
    PixelNoise,
    brightness_of,
    common_of_neighbours,
    estimate_noise,
    gap_weight,
    inverse_square,
    robust_weights,
    with_residuals,
)
from tofcorr.diagnosis.sums.observations import (
    Observations,
    frame_chunks,
    hand_eye_columns,
    predicted_distance,
    predicted_images,
    wall_columns,
    with_planes,
    with_walls_moved,
)
from tofcorr.diagnosis.sums.shared_noise import SharedNoise, shared_noise, whole_images
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.regularisation import penalties_of
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import FitOptions, refuse_missing_inputs
from tofcorr.geometry import se3
from tofcorr.pixels.dataset import Dataset, resolved_planes
from tofcorr.pixels.lattice import covered_domain, domain_from
from tofcorr.plausibility.look import Look
from tofcorr.simulation.effects.base import CatalogueEffect, EffectInputs

TermsAndWords = tuple[ErrorModelOptions, list[str]]
"""Terms of a base model, and what must be said of those left out."""


def unknown_amplitude_columns(observations: Observations, inputs: EffectInputs) -> Tensor:
    """Return the columns, shape (M, K), metres at one prior standard deviation: that of an effect.

    Lindner and Kolb (2007) and Fuchs and May (2007) report errors of one to three centimetres by
    amplitude. K is 0 where the amplitude is known.

    Args:
        observations: The pixels.
        inputs: What effects may depend on.
    """
    if inputs.amplitude is not None:
        return torch.zeros(len(inputs.pixel), 0, dtype=torch.float64)
    bright = inputs.incidence_cosine * inverse_square(inputs.radial_distance)
    exposure = inputs.facts.integration_time
    if exposure is not None and bool((exposure > 0).all()):
        bright = bright * inputs.of_frame(exposure / exposure.mean())
    forms = torch.stack([bright, bright**2, bright * (inputs.rows**2 + inputs.columns**2)], dim=1)
    forms = CatalogueEffect.prior * forms / forms.square().mean(0).sqrt()
    # Four targets at most get columns of their own; all frames of rarer ones share the last.
    names = list(observations.recording.frames.target)
    common = sorted(set(names), key=lambda name: (-names.count(name), name))
    target = inputs.of_frame(torch.tensor([min(common.index(name), 3) for name in names]))
    return torch.cat([forms * (target == k)[:, None] for k in target.unique()], dim=1)


def definite_base(recording: Recording, base: ErrorModelOptions) -> TermsAndWords:
    """Return the terms that the recording can support, with every `auto` replaced, and warnings.

    Amplitude terms are left out, with a warning, where no amplitude was recorded. What else says
    `auto`, a smoothness or a time constant, is determined by the fit of `tofcorr train`. The spread
    of a fixed pattern stays open: it is estimated from the residual of the base fit.

    Args:
        recording: The recording under diagnosis.
        base: The terms asked for.

    Raises:
        CalibrationDataError: The recording lacks what another term needs; names the term.
    """
    warnings, kept = [], tuple(term for term in base.terms if "amplitude" not in term.needs)
    if recording.amplitude is None and len(kept) < len(base.terms):
        dropped = ", ".join(term.kind for term in base.terms if term not in kept)
        warnings = [
            f"{recording.path}: amplitude.npy is missing; the base model has no amplitude term "
            f"({dropped} left out). An error by the amplitude cannot be named, nor another effect "
            "where it could be one; on a patterned target it also raises the noise floor."
        ]
        base = ErrorModelOptions(terms=kept)
    dataset, columns = Dataset((recording,)), base.with_columns()
    refuse_missing_inputs(dataset, base)
    if not any(term.is_open(option) for term in columns.terms for option in term.found_in_data):
        return base, warnings
    frames = np.arange(dataset.num_frames)
    found = fit(dataset, frames, FitOptions(model=columns), covered_domain(dataset, frames))
    definite = iter(found.options.terms)
    terms = tuple(next(definite) if term.has_columns else term for term in base.terms)
    return ErrorModelOptions(terms=terms), warnings


def supported_base(recording: Recording, base: ErrorModelOptions) -> TermsAndWords:
    """Return the terms whose inputs a recording has, and the kinds of the others."""
    dataset, kept, lacking = Dataset((recording,)), [], []
    for term in base.terms:
        try:
            refuse_missing_inputs(dataset, ErrorModelOptions(terms=(term,)))
        except CalibrationDataError:
            lacking.append(term.kind)
        else:
            kept.append(term)
    return ErrorModelOptions(terms=tuple(kept)), lacking


class BaseModel:
    """Hand-eye transform, estimated walls and error model, linear around a start.

    The walls are where the observations have them. Measured planes are no part of the model.

    Args:
        observations: The recording; its ranges scale the variables of the error terms.
        options: Terms of the error model; a fixed pattern among them has no columns here.
        hand_eye_free: Whether the hand-eye transform is estimated.

    Attributes:
        domain: The ranges of the recording's variables.

    Class attributes:
        hand_eye_sd: Prior standard deviations of the hand-eye transform, metres and radians.
        wall_sd: The same of an estimated wall: two turns, radians, and a shift, metres.
        error_sd: The same of the coefficients of error terms, metres. All are chosen so wide that
            they matter only in directions without data.

    Raises:
        CalibrationDataError: The recording lacks what a term needs.
    """

    hand_eye_sd: ClassVar = (0.3, 0.3, 0.3, 0.5, 0.5, 0.5)
    wall_sd: ClassVar = (0.5, 0.5, 0.3)
    error_sd: ClassVar = 1.0

    def __init__(
        self, observations: Observations, options: ErrorModelOptions, *, hand_eye_free: bool
    ) -> None:
        self.observations, self.options = observations, options
        self.hand_eye_free = hand_eye_free
        recording = observations.recording
        self.domain = domain_from(
            recording.camera,
            observations.measured,
            observations.amplitude,
            recording.modulation_frequency,
            observations.conditions,
        )
        self.error_model = ErrorModel(options, self.domain)

    def on(self, observations: Observations) -> "BaseModel":
        """Return the same model, scaled alike, on other pixels or walls."""
        other = copy(self)
        other.observations = observations
        return other

    @property
    def groups(self) -> set[str]:
        """Groups of the terms, as in `Term.group`."""
        return {term.group for term in self.error_model.terms()}

    @property
    def num_hand_eye(self) -> int:
        """Number of columns of the hand-eye transform."""
        return 6 if self.hand_eye_free else 0

    @property
    def num_geometry(self) -> int:
        """Number of columns of hand-eye transform and estimated walls; they come first."""
        return self.num_hand_eye + len(self.wall_sd) * self.observations.num_walls

    @property
    def num_columns(self) -> int:
        """Number of columns."""
        return self.num_geometry + len(self.error_model.symbols())

    def moved(self, step: Tensor) -> "BaseModel":
        """Return the model after a step of the geometry columns, with its walls moved."""
        walls = step[self.num_hand_eye : self.num_geometry]
        return self.on(with_walls_moved(self.observations, walls))

    def prior_precision(self, total_weight: float) -> Tensor:
        r"""Return the precision of the coefficients' priors, with curves held smooth, (K, K).

        To the diagonal of their variances comes :math:`\sum \lambda F^T F`: a strength weighs
        roughness against the mean square, as in training.

        Args:
            total_weight: Sum of the weights of the residuals.
        """
        hand_eye = self.hand_eye_sd[: self.num_hand_eye]
        walls = self.wall_sd * self.observations.num_walls
        sd = [*hand_eye, *walls, *[self.error_sd] * (self.num_columns - self.num_geometry)]
        matrix = torch.diag(torch.tensor(sd, dtype=torch.float64) ** -2)
        for penalty in penalties_of(self.error_model):
            roughness = penalty.factor.T @ penalty.factor
            matrix[self.num_geometry :, self.num_geometry :].add_(
                roughness, alpha=total_weight * float(penalty.strength)
            )
        return matrix

    def error_columns(self, distance: Tensor) -> Tensor:
        """Return constant and terms at predicted distances (M,), metres, shape (M, K)."""
        return self.error_model.columns_at(self.observations.term_inputs(distance)).detach().T

    def residual(self, tool_from_camera: Tensor, coefficients: Tensor) -> Tensor:
        """Return measured less fitted distance with coefficients of the terms, (M,), metres."""
        distance = predicted_distance(self.observations, tool_from_camera)
        error = self.error_columns(distance) @ coefficients
        return self.observations.measured - distance - error

    def linearised(self, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
        """Return predicted distance, (M,), metres, and all columns, (M, K), around a transform."""
        observations, parts = self.observations, []
        distance, columns = hand_eye_columns(observations, tool_from_camera)
        if self.hand_eye_free:
            parts.append(columns)
        if observations.num_walls:
            parts.append(wall_columns(observations, tool_from_camera))
        # Rows (K, M) are filled several times faster than columns.
        return distance, torch.cat([part.T for part in (*parts, self.error_columns(distance))]).T


@dataclass(frozen=True, kw_only=True)
class SimulatorError:
    """The error that a simulator makes at the M chosen pixels.

    Attributes:
        error: Simulated less true distance, shape (M,), metres; NaN where the simulator has no
            distance, or is not known.
        sigma: Standard deviation of its noise, shape (M,), metres.
        tool_from_camera: The simulator's own hand-eye transform, which is exact, shape (4, 4).
        uncertain: What remains uncertain of the error and is the same in all pixels: columns for
            coefficients of variance one, shape (M, J), metres. J is 0 where the simulator was
            seen at the recording's own poses.
        carried: Whether it was fitted at other poses and carried to these, so that the form of the
            fit matters.
        limits: What limits the comparison with it, a sentence each.
    """

    error: Tensor
    sigma: Tensor
    tool_from_camera: Tensor
    uncertain: Tensor
    carried: bool = False
    limits: tuple[str, ...] = ()

    @classmethod
    def exact(cls, error: Tensor, pose: Tensor, sigma: Tensor | None = None) -> "SimulatorError":
        """Return an error (M,) of which nothing but noise (M,) is uncertain; `pose` is (4, 4)."""
        sigma = torch.zeros_like(error) if sigma is None else sigma
        none = error.new_zeros(len(error), 0)
        return cls(error=error, sigma=sigma, tool_from_camera=pose, uncertain=none)

    def at(self, pixels: Tensor | slice) -> "SimulatorError":
        """Return the same at some of the pixels."""
        of_pixels = ("error", "sigma", "uncertain")
        return replace(self, **{name: getattr(self, name)[pixels] for name in of_pixels})

    def twist_to(self, tool_from_camera: Tensor) -> Tensor:
        """Return the change from the simulator's hand-eye transform to another, shape (6,)."""
        return se3.log(se3.inverse(self.tool_from_camera) @ tool_from_camera)

    def residual(self, observations: Observations) -> Tensor:
        """Return measured less simulated distance, the simulator as given, shape (M,), metres."""
        predicted = predicted_distance(observations, self.tool_from_camera)
        return observations.measured - predicted - self.error


# Pixels of all but the last steps. Chosen for speed: so many determine a model of tens of columns
# far better than its robust weights need.
_COARSE_PIXELS = 20_000
# Prior standard deviation around the start, metres and radians, in undetermined directions. Chosen:
# what a ruler and a protractor give.
_START_SD = 0.05


@dataclass(frozen=True, kw_only=True)
class BaseFit:
    """A fitted base model.

    Attributes:
        model: What was fitted; its observations have the estimated walls where the fit put them.
        tool_from_camera: Hand-eye transform, shape (4, 4).
        coefficients: Of constant and error terms, shape (K,).
        residual: Measured less fitted, shape (M,), metres.
        noise: The noise model.
        sigma: Noise of each pixel, shape (M,), metres; that of the simulator included.
        trust: Robust weight of each pixel, 0 to 1, shape (M,).
        shared: What neighbouring pixels share of their noise.
        known: The error that the simulator under diagnosis already makes; None: none was given.
    """

    model: BaseModel
    tool_from_camera: Tensor
    coefficients: Tensor
    residual: Tensor
    noise: PixelNoise
    sigma: Tensor
    trust: Tensor
    shared: SharedNoise
    known: SimulatorError | None = None

    @cached_property
    def weight(self) -> Tensor:
        """Inverse variance of each pixel's own noise, with its robust weight, (M,), 1 / m^2."""
        return self.trust / self.sigma**2

    @cached_property
    def share(self) -> Tensor:
        """Weight of each pixel in a gap in millimetres, 0 to 1, shape (M,).

        Even, but for outliers and for pixels noisier than a gap is large.
        """
        return self.trust * gap_weight(self.sigma)

    @cached_property
    def floor(self) -> float:
        """Root mean square noise under the weights `share`, metres."""
        return float(((self.share * self.sigma**2).sum() / self.share.sum()).sqrt())


def fit_base(
    model: BaseModel, observations: Observations, simulator: SimulatorError | None = None
) -> BaseFit:
    """Fit hand-eye transform and error model to a recording.

    Args:
        model: What to fit. A hand-eye transform that is not free is held at the simulator's, or
            without a simulator at the recording's own.
        observations: The pixels.
        simulator: The error that a given simulator already makes; None: none was given.
    """
    known = torch.zeros_like(observations.measured) if simulator is None else simulator.error
    few = slice(None, None, max(1, len(known) // _COARSE_PIXELS))
    recording = observations.recording
    own = torch.from_numpy(recording.tool_from_camera if recording.moves else np.eye(4))
    guesses = [own] if simulator is None else [simulator.tool_from_camera, own]
    coarse, start = _best_start(model.on(observations.at(few)), known[few], guesses)
    model = model.on(with_planes(observations, coarse.observations.facts))
    brightness = brightness_of(observations)
    noise = estimate_noise(model.observations, start)
    alone = noise.at(brightness, observations.frame)
    sigma = alone if simulator is None else (alone**2 + simulator.sigma**2).sqrt()
    *_, coefficients = _descend(coarse, known[few], start, 1, sigma[few] ** -2)
    first = model.residual(start, coefficients) - known
    common = common_of_neighbours(observations, first)
    deviation = (first - common) * alone / sigma
    noise = with_residuals(noise, brightness, observations.frame, deviation)
    # Residuals hold both noises; the simulator's was extrapolated to the dark as the camera's was.
    sigma = sigma * noise.at(brightness, observations.frame) / alone
    weight = robust_weights(first, sigma, common) / sigma**2
    coarse, pose, coefficients = _descend(coarse, known[few], start, 6, weight[few])
    model = model.on(with_planes(observations, coarse.observations.facts))
    # Both starts are already close: six steps with few pixels, and two with all.
    residual = model.residual(pose, coefficients) - known
    trust = robust_weights(residual, sigma, common_of_neighbours(observations, residual))
    model, pose, coefficients = _descend(model, known, pose, 2, trust / sigma**2)
    residual = model.residual(pose, coefficients) - known
    shared = shared_noise(observations, residual, sigma, trust)
    if simulator is None and observations.is_sample:
        whole = whole_images(model.observations)
        of_whole = model.on(whole).residual(pose, coefficients)
        own = noise.at(brightness_of(whole), whole.frame)
        weights = robust_weights(of_whole, own, common_of_neighbours(whole, of_whole))
        level = shared_noise(whole, of_whole, own, weights).level
        shared = replace(shared, level=max(shared.level, level))
    held = noise.held_to_neighbours(shared.level, shared.striped and shared.from_repeats)
    return BaseFit(
        model=model,
        tool_from_camera=pose,
        coefficients=coefficients,
        residual=residual,
        noise=held,
        sigma=sigma * float(held.sigma[0] / noise.sigma[0]),
        trust=trust,
        shared=shared,
        known=simulator,
    )


def _best_start(model: BaseModel, known: Tensor, guesses: list[Tensor]) -> tuple[BaseModel, Tensor]:
    """Descend from several starts; return the end of the lowest loss, the model with its walls.

    Args:
        model: What to fit, on some pixels.
        known: Error that is known already, shape (M,), metres.
        guesses: Hand-eye transforms to start from; the first is the one to hold where none is free.
    """
    best, best_loss = (model, guesses[0]), float("inf")
    for start in _starts(model, guesses):
        found, pose, coefficients = _descend(model, known, start, 12, None)
        residual = found.residual(pose, coefficients) - known
        loss = float(residual.abs().nan_to_num(1000.0).clamp(max=1.0).mean())
        if loss < best_loss:
            best, best_loss = (found, pose), loss
        # Depth errors leave less than 15 mm, a wrong hand-eye transform more.
        if best_loss < 0.015:
            break
    return best


def _starts(model: BaseModel, guesses: list[Tensor]) -> Iterator[Tensor]:
    """Yield the guesses, then the alignment of frames and planes that an inspection finds.

    Where no hand-eye transform is free, the first is held, and is a start only of walls.
    """
    if not model.hand_eye_free:
        yield from guesses[:1] if model.num_geometry else []
        return
    yield from guesses
    recording = model.observations.recording
    aligned = Look(Dataset((recording,)), resolved_planes("auto", [recording])).as_given
    if aligned is not None:
        yield torch.from_numpy(aligned.hand_eye)


def _descend(
    model: BaseModel, known: Tensor, pose: Tensor, steps: int, weight: Tensor | None
) -> tuple[BaseModel, Tensor, Tensor]:
    """Take Gauss-Newton steps; return hand-eye transform, walls and coefficients.

    A prior around the start holds the directions of the geometry that the poses do not determine.
    Noise and unmodelled effects would otherwise move it far, and with it the geometry that the
    effects depend on.

    Args:
        model: What to fit, on its pixels, with its walls where they start.
        known: Error that is known already, shape (M,), metres.
        pose: Where to start, shape (4, 4).
        steps: How many; without weights at most.
        weight: Of the pixels, 1 / m^2, shape (M,); None: absolute residuals are minimised instead
            of squares (below their median: squares).
    """
    observations, count = model.observations, model.num_geometry
    start, away = pose, torch.zeros(model.num_columns, dtype=torch.float64)
    tie = torch.zeros_like(away)
    # Poses, not their pixels, are independent of one another.
    tie[:count] = _START_SD**-2 * len(observations.measured) / observations.num_units
    target = observations.measured - known
    coefficients = torch.zeros(model.num_columns - count, dtype=torch.float64)
    for _ in range(steps):
        distance, columns = model.linearised(pose)
        usable = (distance > 0) & distance.isfinite()
        response = torch.where(usable, target - distance, 0.0)
        columns = torch.where(usable[:, None], columns, 0.0)
        now, scale, hold = weight, 1.0, 1.0
        if now is None:
            residual = (response - columns[:, count:] @ coefficients).abs()
            now = 1.0 / torch.maximum(residual, residual.median().clamp(min=1 / 1000))
            scale = float(now.mean())
            hold = scale * float(response.abs().median()) ** 2
        weighted = columns * now[:, None]
        if model.hand_eye_free:
            away[:6] = se3.log(se3.inverse(start) @ pose)
        prior = scale * model.prior_precision(float(now.sum()) / scale)
        normal = weighted.T @ columns + prior + hold * torch.diag(tie)
        step = torch.linalg.solve(normal, weighted.T @ response - hold * tie * away)
        coefficients = step[count:]
        away[model.num_hand_eye : count] += step[model.num_hand_eye : count]
        model = model.moved(step)
        if model.hand_eye_free:
            size = torch.maximum(step[:3].norm(), step[3:6].norm())
            # No step is longer than half a metre or a radian.
            pose = pose @ se3.exp(step[:6] / (2 * size).clamp(min=1.0))
        # Of a start, which later steps improve, no pixel need move by less than 0.1 mm.
        if weight is None and float((columns[:, :count] @ step[:count]).abs().max()) < 1e-4:
            break
    return model, pose, coefficients


def filtered_inputs(inputs: EffectInputs, observations: Observations, fit: BaseFit) -> EffectInputs:
    """Return the inputs without the noise that neighbours share; unchanged where they share none.

    Masks leave out parts of the target's plane: there too its distance is taken in place of the
    measured one. Amplitudes are as noisy as phases are, in radians.
    """
    if max(fit.shared.share.values()) == 0 or inputs.distance_images is None:
        return inputs
    images = torch.cat([_with_plane(inputs, observations, p) for p in frame_chunks(observations)])
    inputs = replace(inputs, distance_images=images)
    if inputs.amplitude is None or inputs.modulation_frequency is None:
        return inputs
    return replace(inputs, amplitude_noise=inputs.amplitude * fit.sigma / inputs.metres_per_radian)


def _with_plane(inputs: EffectInputs, observations: Observations, part: slice) -> Tensor:
    """Return distances (F, H, W) of some frames, the plane's where they are off it by noise alone.

    Beside the mask a pixel shows the target's plane if it is off by less than six robust standard
    deviations, as in the noise estimate; some pixels of each frame say its offset and spread.
    """
    assert inputs.distance_images is not None
    plane = predicted_images(observations, inputs.tool_from_camera, part)
    measured = observations.distance_images[part]
    off = measured.double() - plane
    use = observations.on_target[part] & (measured > 0)
    step = max(1, off[0].numel() // _COARSE_PIXELS)
    some = torch.where(use, off, torch.nan).flatten(1)[:, ::step]
    # Of each image; NaN without any used pixel.
    centre = some.nanmedian(1, keepdim=True).values
    limit = 6 * sigma_from_mad((some - centre).abs().nanmedian(1, keepdim=True).values)
    beside = (measured > 0) & ((off - centre[:, None]).abs() < limit[:, None])
    return torch.where(beside, plane.float(), inputs.distance_images[part])
