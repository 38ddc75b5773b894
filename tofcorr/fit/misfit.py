r"""What a fitted model lacks, and what it takes for granted, by what that moves.

Some pixels are looked at beside the fitted model: what it leaves of them, and how its unknowns move
that. A *probe* is a pattern that an error may have which the model lacks. It is fitted beside the
model's unknowns, and beside finer errors over distance, pixel and amplitude, in one linear step. It
counts if leaving out poses says that it is there, and if the hand-eye transform would leave its
stated interval with it. A probe stands for more than one cause: the angle of incidence, say, is in
the error of a glossy wall, in that of light which went by other surfaces, and in that of a wrong
focal length. `tofcorr diagnose` looks for the cause.

No residual shows a small error of the intrinsics or of the planes: the hand-eye transform and the
error terms absorb it. So standard errors cannot hold it. With the model's columns :math:`X`, and
:math:`z`, what the error does to the residuals, the transform moves by
:math:`-(X^\top X)^{-1} X^\top z`.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.estimation.linear import AddedColumns, Curvature, NormalEquations, pose_products
from tofcorr.estimation.robust import LEVEL, student_quantile
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.fit.linear_image import LinearPixels, linearised
from tofcorr.fit.problem import Fit, Shift
from tofcorr.geometry.rays import moved_rays, phase_from_radial_distance, plane_in_frame, tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import draw_pixels, thinned
from tofcorr.plausibility.finding import WORTH_A_WORD


@dataclass(frozen=True, eq=False)
class MisfitPixels:
    """M pixels of F frames beside a model.

    Attributes:
        linear: Their linear form; its unknowns are followed by those of estimated walls. Amplitudes
            that were not recorded are NaN.
        frame: Place of each pixel's frame among those looked at, shape (M,).
        pose: The pose of each frame, shape (F,), counted from zero.
        weight: Of each pixel in the fit, shape (M,).
        on_wall: Where the rays meet the planes, along two directions of the wall, from its middle,
            shape (M, 2), metres.
        recording: Whose camera it is.
        walls_estimated: Whether the walls were estimated with the rest.
    """

    linear: LinearPixels
    frame: Tensor
    pose: Tensor
    weight: Tensor
    on_wall: Tensor
    recording: Recording
    walls_estimated: bool

    def moved_rays(self, x: Tensor, y: Tensor) -> Tensor:
        """Return what it does to the residuals that the rays (x, y, 1) move by so much, (M,)."""
        at, kind = self.linear, self.recording.depth_kind
        return moved_rays(at.ray, at.normal, at.distance, (x, y), kind)

    def error(self, *values: Tensor) -> Tensor:
        """Return what errors of the distance (M,) do to the residual, shape (M, K)."""
        return self.linear.gain[:, None] * torch.stack(values, dim=1)

    @property
    def on_image(self) -> tuple[Tensor, Tensor, Tensor]:
        """Where the rays cross the plane z = 1, and the square of their distance from the axis."""
        x, y = (self.linear.ray[:, axis] / self.linear.ray[:, 2] for axis in (0, 1))
        return x, y, x * x + y * y

    @property
    def brightness(self) -> Tensor | None:
        """The logarithm of the amplitude, standardised; None where it is not known."""
        amplitude = self.linear.pixels.amplitude
        if not bool(amplitude.isfinite().all()):
            return None
        # The logarithm of no amplitude is infinite: it is cut at a thousandth of the median.
        return _standard(amplitude.clamp(min=float(amplitude.median()) / 1000).log())


def misfit_pixels(data: Dataset, fit: Fit, frames: np.ndarray) -> MisfitPixels | None:
    """Read some pixels of 200 of the frames, evenly spread, the same ones at each call.

    Measured: with 200 pixels of each of 40 frames a focal length 1.5 % off is found with p = 1e-3
    to 1e-10, with 400 with 1e-6 to 1e-16; these take 0.07 s, twice as many 0.11 s.

    Args:
        data: The recordings, with the walls of the fit.
        fit: The fitted model.
        frames: Global numbers of the frames, increasing.

    Returns:
        The pixels; None if no ray meets its wall, which a fit that went astray has turned away.
    """
    chosen = thinned(frames, 200)
    hand_eye = fit.solution.parameters.tool_from_camera
    sample = draw_pixels(data, chosen, min(16_000, 400 * len(chosen)), seed=0)
    # At more than 80 degrees, what is computed from the geometry grows without bounds.
    sample = sample.of(sample.cosine(hand_eye) < -math.cos(math.radians(80)))
    if not len(sample.frame):
        return None
    of = chosen[sample.frame.numpy()]
    to_tool = hand_eye.expand(len(of), 4, 4)
    plane = plane_in_frame(sample.normal_tool, sample.offset_tool, to_tool)
    seen = linearised(fit.model.error, sample.pixels, sample.ray, plane, twist=True)
    pose, across = data.column("world_from_tool")[of] @ hand_eye, data.column("normal_world")[of]
    world = torch.einsum("mij,mj->mi", pose[:, :3, :3], seen.points) + pose[:, :3, 3]
    on_wall = torch.einsum("mkj,mj->mk", tangents(across), world)
    unknowns = seen.unknowns
    if fit.walls is not None:
        # Two turns and a shift of each wall.
        wall = torch.from_numpy(fit.walls.of_frame[of])
        walls = torch.zeros(len(wall), int(wall.max()) + 1, 3).to(on_wall)
        walls[torch.arange(len(wall)), wall] = torch.nn.functional.pad(on_wall, (0, 1), value=1.0)
        unknowns = torch.cat([unknowns, walls.flatten(1)], dim=1)
    pixels, equal = seen.pixels, torch.ones_like(seen.residual)
    if not data.has_amplitude:
        pixels = pixels._replace(amplitude=torch.nan * equal)
    return MisfitPixels(
        linear=replace(seen, pixels=pixels, unknowns=unknowns),
        frame=sample.frame,
        pose=torch.from_numpy(np.unique(data.pose_groups()[chosen], return_inverse=True)[1]),
        weight=equal if fit.weights is None else fit.weights.of_sample(sample),
        on_wall=on_wall - on_wall.median(dim=0).values,
        recording=data.first,
        walls_estimated=fit.walls is not None,
    )


Probes = dict[str, tuple[str, Tensor]]
"""By name, what the residuals do (it follows "the residuals"), and what they would be, without a
unit, shape (M, K)."""


def _standard(values: Tensor) -> Tensor:
    return (values - values.mean()) / values.std().clamp(min=torch.finfo(torch.float64).eps)


def finer_forms(seen: MisfitPixels) -> Probes:
    """Return errors over distance, pixel and amplitude that are finer than those of a usual model.

    What a smooth term cannot follow leaves some of itself in every other probe.
    """
    (x, y, square), u, bright = seen.on_image, _standard(seen.linear.distance), seen.brightness
    place = x * y, square**2, x**3, y**3, x * x * y, x * y * y
    finely = "more finely than the model"
    found = {
        "distance": (f"follow the distance {finely}", seen.error(u**4, u**5)),
        "pixel": (f"follow the place in the image {finely}", seen.error(*place)),
    }
    if bright is not None:
        trace = "follow the amplitude otherwise than the model"
        found["amplitude"] = trace, seen.error(bright, bright**2)
    return found


def probes(seen: MisfitPixels) -> Probes:
    """Return the other probes that a recording allows."""
    (x, y, square), bright, error = seen.on_image, seen.brightness, seen.error
    distance, facing = seen.linear.distance, -seen.linear.gain
    amplitude = seen.linear.pixels.amplitude
    (s, t), when = seen.on_wall.unbind(dim=1), _standard(seen.frame.to(torch.float64))
    one, none, u = torch.ones_like(x), torch.zeros_like(x), _standard(distance)
    frequency = seen.recording.modulation_frequency
    phase = None if frequency is None else phase_from_radial_distance(distance, frequency)
    # The error by a weak signal of a path twice as long, in units of its share.
    of_echo = distance if phase is None else phase.sin()

    def lens(*moves: tuple[Tensor, Tensor]) -> Tensor:
        return torch.stack([seen.moved_rays(*move) for move in moves], dim=1)

    tilted = "are those of image axes that are scaled or tilted"
    found = {
        "incidence": ("follow the angle of incidence", error(1 / facing - 1, (1 - facing) ** 2)),
        "order": ("follow the order of the frames", error(when, when**2)),
        "focal_length": ("are those of another focal length", lens((x, y))),
        "aspect": (tilted, lens((x, -y), (y, x))),
        "principal_point": ("are those of another principal point", lens((one, none), (none, one))),
        "radial": ("are those of another radial distortion", lens((x * square, y * square))),
        "prism": ("are those of a wedge before the lens", lens((square, none), (none, square))),
        "pixel_by_distance": (
            "follow pixel and distance together",
            error(x * u, y * u, square * u),
        ),
        "target_shape": ("are those of a bent target", torch.stack([s * s, t * t, s * t], dim=1)),
        # Light from all sides: its error grows as the direct light falls.
        "room": ("grow as light from all sides makes them", error(distance**2 / facing)),
        # Light that the camera's mount sends back to the wall.
        "facing": (
            "are those of light between target and camera",
            error(of_echo * facing / distance**2),
        ),
    }
    if not seen.walls_estimated:
        found["plane"] = ("are those of planes elsewhere", torch.stack([one, s, t], dim=1))
    if phase is not None:
        # Four waves in one unambiguous range: of the third harmonic with four taps (Lange 2000).
        waves = error((4 * phase).sin(), (4 * phase).cos())
        found["circular"] = "repeat over the distance", waves
    if bright is not None:
        # The ratio is cut, so that single dark pixels do not decide.
        ratio = (amplitude.median() / amplitude).clamp(max=20)
        together = "follow amplitude and distance together"
        found["amplitude_by_distance"] = (together, error(bright * u))
        found["stray_light"] = ("are those of light that strayed in the lens", error(ratio))
    return found


def find_misfit(seen: MisfitPixels, fit: Fit) -> Shift | None:
    """Look for an error that a fitted model lacks and that matters to the hand-eye transform.

    Args:
        seen: Some pixels of the frames, fitted or held out, beside the fitted model.
        fit: The fitted model, its hand-eye transform estimated.

    Returns:
        The least likely to be chance of those that would move the transform out of its interval.
        Finer errors over distance, pixel and amplitude come last: all others stand beside them.
        None where there is none, or too few poses.
    """
    # Each pose determines about three of the thirty unknowns, and the scatter between poses must be
    # known beside them.
    if len(seen.pose.unique()) < 16:
        return None
    half = student_quantile(1 - LEVEL / 2, fit.covariance.degrees_of_freedom)
    half = half * fit.hand_eye_covariance.diagonal().clamp(min=0).sqrt()
    finer, others = finer_forms(seen), probes(seen)
    groups = _shifts(seen, fit, others, finer), _shifts(seen, fit, finer, {})
    # The probability is that of any probe by chance, over all that were tried (Bonferroni).
    tried = sum(len(group) for group in groups)
    for group in groups:
        counting = [
            one._replace(p_value=p_value)
            for one in group
            if (p_value := min(1.0, tried * (one.p_value or 0.0))) < LEVEL
            and bool((one.twist.abs() > half).any())
            and max(one.size) > WORTH_A_WORD
        ]
        if counting:
            return min(counting, key=lambda one: one.p_value or 0.0)
    return None


def _shifts(seen: MisfitPixels, fit: Fit, tried: Probes, beside: Probes) -> list[Shift]:
    """Fit each probe beside the model and all of some others; return what that moves.

    Those that tell nothing are left out, and those that would be no error of a camera, but two
    unknowns of opposite signs: larger than the widest prior.
    """
    # Of a root mean square error of the distance of 1.
    least, at = torch.finfo(torch.float64).eps, seen.linear
    scaled = [
        columns / (columns / at.gain[:, None]).square().mean(dim=0).sqrt().clamp(min=least)
        for _, columns in (*beside.values(), *tried.values())
    ]
    every = torch.cat([at.unknowns, *scaled, at.residual[:, None]], dim=1)
    products = pose_products(every, seen.pose[seen.frame], seen.weight.clamp(min=0))
    known = at.unknowns.shape[1] + sum(columns.shape[1] for columns in scaled[: len(beside)])
    compared = AddedColumns(products, _prior(seen, fit, known))
    found, first = [], 0
    for name, (trace, columns) in tried.items():
        moved = compared(list(range(first, first + columns.shape[1])))
        first += columns.shape[1]
        if moved is not None and float(moved.values.abs().max()) < PRIOR_SIGMA:
            found.append(Shift(name, trace, moved.shift[:6], moved.p_value))
    return found


def assumptions(seen: MisfitPixels, fit: Fit) -> tuple[Shift, ...]:
    """Return what errors of the intrinsics, of measured planes and of the robot's lengths would do.

    Args:
        seen: Some pixels beside the fitted model.
        fit: The fitted model, its hand-eye transform estimated.
    """
    (fx, _, _), (_, fy, _), _ = seen.recording.camera.matrix
    x, y, _ = seen.on_image
    one, none = torch.ones_like(x), torch.zeros_like(x)
    # Such errors remain after a careful calibration of the lens, and of a wall by touching it. With
    # a longer focal length rays come nearer the axis, with a shifted point they move the other way.
    # A zone of a sensor of few is as wide as many pixels: it is known to a part of one.
    step = min(1.0, fit.domain.width / 32)
    right, down = seen.moved_rays(-step * one / fx, none), seen.moved_rays(none, -step * one / fy)
    lens = {
        "focal_length": ("focal length 0.1 % longer", -seen.moved_rays(x, y) / 1000),
        "principal_point_right": (f"principal point {step:g} px further right", right),
        "principal_point_down": (f"principal point {step:g} px further down", down),
    }
    # A single ray is where the hand-eye transform puts it, whatever the lens.
    errors = {} if fit.domain.height * fit.domain.width == 1 else lens
    # Poses and planes 1 % longer: the points in the tool frame should be farther from its origin.
    camera = fit.solution.parameters.tool_from_camera
    from_tool = seen.linear.points + camera[:3, :3].T @ camera[:3, 3]
    of_scale = -(from_tool * seen.linear.normal).sum(dim=1) / 100
    errors["robot_scale"] = "robot's lengths 1 % longer", of_scale
    if not seen.walls_estimated:
        errors["plane_offset"] = ("d of all planes 1 mm larger", one / 1000)
        errors["plane_tilt"] = ("all planes turned by 0.1 deg", math.radians(1 / 10) * seen.on_wall)
    weighted = seen.linear.unknowns * seen.weight.clamp(min=0)[:, None]
    hessian = weighted.T @ seen.linear.unknowns
    inverse = Curvature(hessian + _prior(seen, fit, len(hessian)).hessian).inverse[:6]
    found = []
    for name, (words, columns) in errors.items():
        moved = -(inverse @ (weighted.T @ columns.view(len(one), -1)))
        # Of turns about two axes, about the axis where the camera moves most.
        worst = torch.linalg.svd(moved[:3], full_matrices=False).Vh[0]
        found.append(Shift(name, words, moved @ (worst if len(worst) > 1 else worst.abs())))
    return tuple(found)


def _prior(seen: MisfitPixels, fit: Fit, unknowns: int) -> NormalEquations:
    """Return the prior of the fit for all unknowns, by the share of the weight that was read."""
    zero, prior = torch.zeros(unknowns, unknowns, dtype=torch.float64), fit.total_prior
    none = NormalEquations(zero.sum(), zero.sum(dim=0), zero)
    if prior is None:
        return none
    share = float(seen.weight.sum() / fit.moments.gram[:, -1, -1].sum())
    held = replace(prior, variance=share * prior.variance)
    return none.plus(held.equations(fit.solution.parameters))
