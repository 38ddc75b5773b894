"""Fits the base model in the forward form: robustly, from several starts.

A simulator under diagnosis already makes an error; it is split from the geometry and known to the
fit. Where a camera filters its images and neighbours share noise, effects that mix neighbouring
pixels of measured images would explain the noise of the very pixel whose error is to be explained:
they look at images without it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_model import BaseModel, with_planes
from tofcorr.diagnosis.sums.noise import (
    PixelNoise,
    brightness_of,
    common_of_neighbours,
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
from tofcorr.diagnosis.sums.shared_noise import SharedNoise, shared_noise, whole_images
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.spread import sigma_from_mad


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
        shared = shared.with_level_of(shared_noise(whole, of_whole, own, weights))
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
    starts = guesses[:1]
    if model.hand_eye_free:
        # The last guess may be turned about the optical axis by one, two or three quarters.
        quarter = torch.tensor([0, 0, 0, 0, 0, torch.pi / 2], dtype=torch.float64)
        turned = [guesses[-1] @ se3.exp(number * quarter) for number in (1, 2, 3)]
        starts = [*guesses, *closed_form(model.observations), *turned]
    best, best_loss = (model, guesses[0]), float("inf")
    for start in starts if model.num_geometry else []:
        found, pose, coefficients = _descend(model, known, start, 12, None)
        residual = found.residual(pose, coefficients) - known
        loss = float(residual.abs().nan_to_num(1000.0).clamp(max=1.0).mean())
        # Another start must be better by a tenth. Depth errors leave less than 15 mm, a wrong
        # hand-eye transform more.
        if loss < 0.9 * best_loss:
            best, best_loss = (found, pose), loss
        if best_loss < 0.015:
            break
    return best


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
        steps: At most so many.
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
    # Steps end when one moves no pixel by more than this, metres: far below any noise; and for a
    # start, which the next steps improve, far below what they move.
    small = 1e-4 if weight is None else 1e-7
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
        if count and float((columns[:, :count] @ step[:count]).abs().max()) < small:
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
    noise = inputs.amplitude * fit.sigma / inputs.metres_per_radian
    return replace(inputs, amplitude_noise=noise)


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

    def median(values: Tensor) -> Tensor:
        """Return the median of the used pixels of each image, (F, 1, 1); NaN without any."""
        some = torch.where(use, values, torch.nan).flatten(1)[:, ::step]
        return some.nanmedian(1).values[:, None, None]

    away = (off - median(off)).abs()
    beside = (measured > 0) & (away < 6 * sigma_from_mad(median(away)))
    return torch.where(beside, plane.float(), inputs.distance_images[part])
