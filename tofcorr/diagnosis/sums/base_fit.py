"""Fits the base model in the forward form: robustly, from several starts.

A simulator under diagnosis already makes an error; it is split from the geometry and known to the
fit. Where a camera filters its images and neighbours share noise, effects that mix neighbouring
pixels of measured images would explain the noise of the very pixel whose error is to be explained:
they look at images without it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_model import BaseModel
from tofcorr.diagnosis.sums.noise import (
    MAD_TO_SIGMA,
    Neighbours,
    PixelNoise,
    brightness_of,
    estimate_noise,
    gap_weight,
    robust_weights,
    with_residuals,
)
from tofcorr.diagnosis.sums.observations import (
    Observations,
    frame_chunks,
    predicted_distance,
    predicted_images,
)
from tofcorr.diagnosis.sums.shared_noise import SharedNoise, shared_noise, with_level_of_images
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.simulation.effects.inputs import EffectInputs


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
    """

    error: Tensor
    sigma: Tensor
    tool_from_camera: Tensor
    uncertain: Tensor
    carried: bool = False

    @classmethod
    def exact(cls, error: Tensor, pose: Tensor, sigma: Tensor | None = None) -> "SimulatorError":
        """Return an error (M,) of which nothing but noise (M,) is uncertain; `pose` is (4, 4)."""
        sigma = torch.zeros_like(error) if sigma is None else sigma
        none = error.new_zeros(len(error), 0)
        return cls(error=error, sigma=sigma, tool_from_camera=pose, uncertain=none)

    def at(self, pixels: Tensor | slice) -> "SimulatorError":
        """Return the same at some of the pixels."""
        return replace(
            self,
            error=self.error[pixels],
            sigma=self.sigma[pixels],
            uncertain=self.uncertain[pixels],
        )

    def residual(self, observations: Observations) -> Tensor:
        """Return measured less simulated distance, the simulator as given, shape (M,), metres."""
        predicted = predicted_distance(observations, self.tool_from_camera)
        return observations.measured - predicted - self.error


def first_guesses(observations: Observations, simulator: SimulatorError | None) -> list[Tensor]:
    """Return hand-eye transforms to start from; the first is the one to hold where none is free."""
    recording = observations.recording
    own = torch.eye(4, dtype=torch.float64)
    if recording.moves:
        own = torch.from_numpy(recording.tool_from_camera)
    return [own] if simulator is None else [simulator.tool_from_camera, own]


def closed_form(observations: Observations, *, least_singular_value: float = 0.2) -> list[Tensor]:
    """Solve n . (R D v + t) + d = 0 for the entries of R and t, then make R a rotation.

    It serves as a start only, because its regressors contain the measured distance.

    Args:
        observations: The pixels.
        least_singular_value: The closed form is no start if a singular value of its matrix is below
            this. A rotation has only ones; chosen with room for noise.
    """
    facts, frame = observations.facts, observations.frame
    points = observations.rays * observations.measured[:, None]
    normal, offset = plane_in_frame(facts.normal_world, facts.offset, facts.world_from_tool)
    normal, offset = normal[frame], offset[frame]
    design = torch.cat([(normal[:, :, None] * points[:, None, :]).flatten(1), normal], dim=1)
    solved = torch.linalg.lstsq(design, -offset[:, None], driver="gelsd").solution[:, 0]
    u, values, vt = torch.linalg.svd(solved[:9].reshape(3, 3))
    if not bool(values.isfinite().all()) or float(values[-1]) < least_singular_value:
        return []
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))]).double()) @ vt
    height = offset + (normal * (points @ rotation.T)).sum(1)
    shift = torch.linalg.lstsq(normal, -height[:, None], driver="gelsd").solution[:, 0]
    return [se3.assemble(rotation, shift)]


def quarter_turns(guess: Tensor) -> list[Tensor]:
    """Return a hand-eye transform turned about the optical axis by one, two and three quarters."""
    turn = torch.tensor([0, 0, 0, 0, 0, torch.pi / 2], dtype=torch.float64)
    return [guess @ se3.exp(quarter * turn) for quarter in (1, 2, 3)]


# Pixels of all but the last steps, and Gauss-Newton steps of the search for a start. Chosen for
# speed: so many determine a model of tens of columns far better than its robust weights need.
_COARSE_PIXELS, _COARSE_STEPS = 20_000, 12
# A start whose mean absolute residual is below this, metres, is accepted without trying others.
# Chosen: above what depth errors leave, below what a wrong hand-eye transform leaves.
_GOOD_START = 0.015
# Another start replaces the best one if its loss is below this share of the best. Chosen.
_BETTER_START = 0.9
# Most Gauss-Newton steps from the best start with few pixels, and from there with all. Chosen; both
# starts are already close.
_FINE_STEPS, _LAST_STEPS = 6, 2
# Prior standard deviation around the start, metres and radians, in undetermined directions. Chosen:
# what a ruler and a protractor give.
_START_SD = 0.05
# Iterations end when a step moves no pixel by more than this, metres. Chosen, far below any noise;
# and for a start, which the next steps improve, far below what they move.
_SMALL_STEP, _SMALL_COARSE_STEP = 1e-7, 1e-4
# Longest step of the hand-eye transform, metres and radians. Chosen.
_LONGEST_STEP = 0.5


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
    model, start = _best_start(
        model.on(observations), known, first_guesses(observations, simulator), few
    )
    coarse = model.on(model.observations.at(few))
    brightness = brightness_of(observations)
    noise = estimate_noise(model.observations, start)
    own = noise.at(brightness, observations.frame)
    sigma = own if simulator is None else (own**2 + simulator.sigma**2).sqrt()
    coefficients = _descend(coarse, known[few], start, 1, sigma[few] ** -2).coefficients
    first = _Found(model, start, coefficients).residual(known)
    groups = Neighbours(observations)
    common = groups.common(first)
    noise = with_residuals(noise, brightness, observations.frame, (first - common) * own / sigma)
    # Residuals hold both noises; the simulator's was extrapolated to the dark as the camera's was.
    sigma = sigma * noise.at(brightness, observations.frame) / own
    trust = robust_weights(first, sigma, common)
    found = _descend(coarse, known[few], start, _FINE_STEPS, (trust / sigma**2)[few])
    found = found._replace(model=model.with_walls_of(found.model))
    residual = found.residual(known)
    trust = robust_weights(residual, sigma, groups.common(residual))
    found = _descend(found.model, known, found.pose, _LAST_STEPS, trust / sigma**2)
    residual = found.residual(known)
    shared = shared_noise(observations, residual, sigma, trust)
    if simulator is None:
        shared = with_level_of_images(shared, found.model.observations, noise, found.residual_on)
    held = noise.held_to_neighbours(shared.level, shared.striped and shared.from_repeats)
    sigma = sigma * float(held.sigma[0] / noise.sigma[0])
    return BaseFit(
        model=found.model,
        tool_from_camera=found.pose,
        coefficients=found.coefficients,
        residual=residual,
        noise=held,
        sigma=sigma,
        trust=trust,
        shared=shared,
        known=simulator,
    )


class _Found(NamedTuple):
    """Where a descent ended: the model with its walls moved, hand-eye transform, coefficients."""

    model: BaseModel
    pose: Tensor
    coefficients: Tensor

    def residual(self, known: Tensor) -> Tensor:
        """Return measured less fitted, shape (M,), metres."""
        observations = self.model.observations
        distance = predicted_distance(observations, self.pose)
        error = self.model.error_columns(distance) @ self.coefficients
        return observations.measured - known - distance - error

    def residual_on(self, observations: Observations) -> Tensor:
        """Return measured less fitted of other pixels of these frames, metres."""
        other = self._replace(model=self.model.on(observations))
        return other.residual(torch.zeros_like(observations.measured))


def _best_start(
    model: BaseModel, known: Tensor, guesses: list[Tensor], few: slice
) -> tuple[BaseModel, Tensor]:
    """Descend from several starts, with few pixels; return the end of the lowest loss."""
    observations = model.observations
    if not model.num_geometry:
        return model, guesses[0]
    thin, known = observations.at(few), known[few]
    coarse = model.on(thin)
    starts = guesses[:1]
    if model.hand_eye_free:
        starts = [*guesses, *closed_form(thin), *quarter_turns(guesses[-1])]
    best, best_loss = _Found(coarse, guesses[0], torch.zeros(0)), float("inf")
    for start in starts:
        found = _descend(coarse, known, start, _COARSE_STEPS, None)
        residual = found.residual(known)
        loss = float(residual.abs().nan_to_num(1e3).clamp(max=1.0).mean())
        if loss < _BETTER_START * best_loss:
            best, best_loss = found, loss
        if best_loss < _GOOD_START:
            break
    return model.with_walls_of(best.model), best.pose


def _descend(
    model: BaseModel, known: Tensor, pose: Tensor, steps: int, weight: Tensor | None
) -> _Found:
    """Take Gauss-Newton steps; return hand-eye transform, walls and coefficients.

    A prior around the start holds the directions of the geometry that the poses do not determine.
    Noise and unmodelled effects would otherwise move it far, and with it the geometry that the
    effects depend on.

    Args:
        model: What to fit, on its pixels, with its walls where they start.
        known: Error that is known already, shape (M,), metres.
        pose: Where to start, shape (4, 4).
        steps: At most so many.
        weight: Of the pixels, 1 / m^2, shape (M,); None: absolute residuals are minimised instead
            of squares (below their median: squares).
    """
    observations, count = model.observations, model.num_geometry
    prior, roughness = model.prior_precision(), model.roughness()
    start, away = pose, torch.zeros(model.num_columns, dtype=torch.float64)
    tie = torch.zeros_like(away)
    # Poses, not their pixels, are independent of one another.
    tie[:count] = _START_SD**-2 * len(observations.measured) / observations.num_units
    target = observations.measured - known
    coefficients = torch.zeros(model.num_columns - count, dtype=torch.float64)
    small = _SMALL_COARSE_STEP if weight is None else _SMALL_STEP
    for _ in range(steps):
        distance, columns = model.linearised(pose)
        usable = (distance > 0) & distance.isfinite()
        response = torch.where(usable, target - distance, 0.0)
        if not bool(usable.all()):
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
        normal = weighted.T @ columns + scale * prior + hold * torch.diag(tie)
        normal = normal + now.sum() * roughness
        step = torch.linalg.solve(normal, weighted.T @ response - hold * tie * away)
        coefficients = step[count:]
        away[model.num_hand_eye : count] += step[model.num_hand_eye : count]
        model = model.moved(step)
        if model.hand_eye_free:
            size = torch.maximum(step[:3].norm(), step[3:6].norm()) / _LONGEST_STEP
            pose = pose @ se3.exp(step[:6] / size.clamp(min=1.0))
        if count and float((columns[:, :count] @ step[:count]).abs().max()) < small:
            break
    return _Found(model, pose, coefficients)


# Beside the mask a pixel shows the target's plane if it is off by less than this many robust
# standard deviations. Chosen, as in the noise estimate.
_CLIP = 6.0
# Pixels of a frame that its offset and spread are taken from, at most. Chosen to bound the time.
_MOST_OF_FRAME = 20_000


def filtered_inputs(inputs: EffectInputs, observations: Observations, fit: BaseFit) -> EffectInputs:
    """Return the inputs without the noise that neighbours share; unchanged where they share none.

    Masks leave out parts of the target's plane: there too its distance is taken in place of the
    measured one. Amplitudes are as noisy as phases are, in radians.
    """
    if max(fit.shared.share.values()) == 0 or inputs.distance_images is None:
        return inputs
    images = _with_plane(inputs.distance_images, observations, fit.tool_from_camera)
    inputs = replace(inputs, distance_images=images)
    if inputs.amplitude is None or inputs.modulation_frequency is None:
        return inputs
    noise = inputs.amplitude * fit.sigma / inputs.metres_per_radian
    return replace(inputs, amplitude_noise=noise)


def _with_plane(images: Tensor, observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return distances (F, H, W) with the plane's where measured ones are off it by noise alone."""
    found = []
    for part in frame_chunks(observations):
        plane = predicted_images(observations, tool_from_camera, part)
        measured = observations.distance_images[part]
        off = measured.double() - plane
        use = observations.on_target[part] & (measured > 0)
        middle = _median(off, use)
        away = (off - middle).abs()
        beside = (measured > 0) & (away < _CLIP * MAD_TO_SIGMA * _median(away, use))
        found.append(torch.where(beside, plane.float(), images[part]))
    return torch.cat(found)


def _median(images: Tensor, use: Tensor) -> Tensor:
    """Return the median of used pixels of each image, (F, 1, 1); NaN where there are none."""
    step = max(1, images[0].numel() // _MOST_OF_FRAME)
    chosen = torch.where(use, images, torch.nan).flatten(1)[:, ::step]
    return chosen.nanmedian(1).values[:, None, None]
