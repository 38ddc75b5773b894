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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import FrameBatch, Recording
from tofcorr.error_terms.base import Term
from tofcorr.estimation.accumulator import Design
from tofcorr.estimation.linear import Added, AddedColumns, Curvature, NormalEquations, pose_products
from tofcorr.estimation.robust import student_quantile
from tofcorr.fit.result import Assumption, Fit, Misfit
from tofcorr.fit.walls import name_walls
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import moved_rays, phase_from_radial_distance, tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import distance_to_plane, thinned

# Pixels looked at in all, and the least and the most of one frame. Measured: with 200 of each of 40
# frames a focal length 1.5 % off is found with p = 1e-3 to 1e-10, with 400 with 1e-6 to 1e-16;
# these take 0.07 s, twice as many 0.11 s.
_ALL_PIXELS, _OF_FRAME = 16_000, (80, 400)
# Largest error that a probe may stand for, root mean square, metres: what is larger is no error of
# a camera, but two unknowns of opposite signs. And the least shift of the hand-eye transform that
# is reported, metres or radians: no error of a usual camera is smaller. Chosen.
_LARGEST, _LEAST = 0.05, 1e-3


@dataclass(frozen=True, eq=False)
class MisfitPixels:
    """M pixels of F frames beside a model of P unknowns.

    Attributes:
        frame: Place of each pixel's frame among those looked at, shape (M,).
        residual: Signed distance of the corrected point to its plane, shape (M,), metres.
        jacobian: Its derivatives by a step of `Parameters.moved`, then by the walls if they were
            estimated, shape (M, P). The error terms are taken at the distance that the camera
            should measure: that has no noise, which the residual has as well.
        weight: Of each pixel in the fit, shape (M,).
        cosine: Between ray and normal, shape (M,), negative: the change of the residual with the
            measured distance.
        distance: To the plane along the ray, shape (M,), metres.
        ray: Unit rays in the camera frame, shape (M, 3).
        normal: Of the planes in the camera frame, shape (M, 3).
        world: Where the rays meet the planes in the world, shape (M, 3), metres.
        on_wall: The same along two directions of the wall, from its middle, shape (M, 2), metres.
        amplitude: Shape (M,); NaN where none was recorded.
        before: What the same pixel measured in the frame before, shape (M,), metres; NaN: nothing.
        amplitude_before: Its amplitude there, shape (M,); NaN: unknown.
        pose: The pose of each frame, shape (F,), counted from zero.
        depth_kind: Of the recording: an error of a ray leaves the depth as it was stored.
        modulation_frequency: Hz; None if unknown.
        walls_estimated: Whether the walls were estimated with the rest.
    """

    frame: Tensor
    residual: Tensor
    jacobian: Tensor
    weight: Tensor
    cosine: Tensor
    distance: Tensor
    ray: Tensor
    normal: Tensor
    world: Tensor
    on_wall: Tensor
    amplitude: Tensor
    before: Tensor
    amplitude_before: Tensor
    pose: Tensor
    depth_kind: str
    modulation_frequency: float | None
    walls_estimated: bool

    def moved_rays(self, x: Tensor, y: Tensor) -> Tensor:
        """Return what it does to the residuals that the rays (x, y, 1) move by so much, (M,)."""
        return moved_rays(self.ray, self.normal, self.distance, (x, y), self.depth_kind)


def misfit_pixels(data: Dataset, fit: Fit, frames: np.ndarray) -> MisfitPixels | None:
    """Read some pixels of some frames, the same ones at each call.

    Args:
        data: The recordings, with the walls of the fit.
        fit: The fitted model.
        frames: Global numbers of the frames, increasing; of many, 200 evenly spread ones are read.

    Returns:
        The pixels; None if no ray meets its wall, which a fit that went astray has turned away.
    """
    chosen = thinned(frames, 200)
    number = int(np.clip(_ALL_PIXELS // len(chosen), *_OF_FRAME))
    reader = _Reader(data, fit, number)
    generator = torch.Generator().manual_seed(0)
    parts: list[dict[str, Tensor]] = []
    for recording, start, local in data.by_recording(chosen):
        for batch in data.batches(start + local):
            left = distance_to_plane(fit.model, batch, data.ray_directions())
            parts += [
                reader.pixels(recording, start, batch, left, k, generator)
                for k in range(len(batch.indices))
            ]
    counts = torch.tensor([len(part["residual"]) for part in parts])
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    if not len(joined["residual"]):
        return None
    joined["on_wall"] = joined["on_wall"] - joined["on_wall"].median(dim=0).values
    return MisfitPixels(
        **joined,
        frame=torch.arange(len(parts)).repeat_interleave(counts),
        pose=torch.from_numpy(np.unique(data.pose_groups()[chosen], return_inverse=True)[1]),
        depth_kind=data.first.depth_kind,
        modulation_frequency=data.first.modulation_frequency,
        walls_estimated=fit.walls is not None,
    )


class _Reader:
    """Computes the pixels of one frame after another."""

    def __init__(self, data: Dataset, fit: Fit, number: int) -> None:
        self._data, self._fit, self._number = data, fit, number
        self._rays = data.ray_directions()
        self._model = fit.model.error
        self._design = Design(self._model, fit.domain, self._rays)
        self._hand_eye = fit.solution.parameters.tool_from_camera
        self._wall = None if fit.walls is None else torch.from_numpy(name_walls(data).of_frame)

    def pixels(
        self,
        recording: Recording,
        start: int,
        batch: FrameBatch,
        left: Tensor,
        k: int,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return some pixels of one frame, as attributes of `MisfitPixels`.

        Args:
            recording: That of the frame.
            start: Global number of its first frame.
            batch: Frames of it.
            left: Distances of their points to the planes, shape (B, H, W).
            k: Which of them.
            generator: Picks the pixels.
        """
        local = int(batch.indices[k]) - start
        table, hand_eye = recording.frames, self._hand_eye
        normal = batch.normal_tool[k] @ hand_eye[:3, :3]
        offset = batch.normal_tool[k] @ hand_eye[:3, 3] + batch.offset_tool[k]
        facing = self._rays.reshape(-1, 3) @ normal
        # At more than 80 degrees, what is computed from the geometry grows without bounds.
        seen = batch.valid[k].reshape(-1) & (facing < -0.17)
        some = seen.nonzero()[:, 0]
        some = some[torch.randperm(len(some), generator=generator)[: self._number]]
        ray, cosine = self._rays.reshape(-1, 3)[some], facing[some]
        distance = -offset / cosine
        measured = batch.radial_distance[k].reshape(-1)[some]
        amplitude = torch.full_like(measured, torch.nan)
        if batch.amplitude is not None:
            amplitude = batch.amplitude[k].reshape(-1)[some]
        residual = left[k].reshape(-1)[some]
        # What the camera should measure: the distance to the plane and its own error.
        noiseless = measured - residual / cosine
        columns = self._functions(batch, k, some, noiseless, amplitude)
        points = ray * distance[:, None]
        normals = normal.expand(len(some), 3)
        world_from_camera = torch.from_numpy(table.world_from_tool[local]) @ hand_eye
        world = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        across = tangents(torch.from_numpy(table.normal_world[local]))
        turned = torch.linalg.cross(points, normals)
        own = torch.cat([normals, turned, -cosine[:, None] * columns.T], dim=1)
        before = local - 1 if local else None
        jacobian = torch.cat([own, self._by_walls(batch.indices[k], world @ across.T)], dim=1)
        return {
            "residual": residual,
            "jacobian": jacobian,
            "weight": _weight(self._fit, batch, k, some),
            "cosine": cosine,
            "distance": distance,
            "ray": ray,
            "normal": normals,
            "world": world,
            "on_wall": world @ across.T,
            "amplitude": amplitude,
            "before": _distance_at(recording, before, some, ray),
            "amplitude_before": _image_at(recording.amplitude, before, some),
        }

    def _functions(
        self, batch: FrameBatch, k: int, some: Tensor, distance: Tensor, amplitude: Tensor
    ) -> Tensor:
        """Return what the coefficients multiply, at some measured distances, shape (K, M)."""
        design = self._design
        known = amplitude if self._data.has_amplitude else torch.ones_like(distance)
        pixel = design.pixel_functions.flatten(1)[:, some][design.pixel]
        signal = design.signal_functions(distance, known)[design.signal]
        terms: list[Term] = list(self._model.condition_terms)  # type: ignore[arg-type]
        assert batch.conditions is not None
        of_frame = [term.basis(batch.conditions[k : k + 1]) for term in terms]  # type: ignore[operator]
        return torch.cat([(signal * pixel)[1:], *(part.expand(-1, len(some)) for part in of_frame)])

    def _by_walls(self, frame: Tensor, on_wall: Tensor) -> Tensor:
        """Return the derivatives by two turns and a shift of each estimated wall, (M, 3 W)."""
        if self._wall is None:
            return on_wall.new_zeros(len(on_wall), 0)
        found = on_wall.new_zeros(len(on_wall), int(self._wall.max()) + 1, 3)
        found[:, self._wall[frame], :2] = on_wall
        found[:, self._wall[frame], 2] = 1.0
        return found.flatten(1)


def _weight(fit: Fit, batch: FrameBatch, k: int, some: Tensor) -> Tensor:
    if fit.weights is None:
        return torch.ones(len(some), dtype=torch.float64)
    return fit.weights(batch)[k].reshape(-1)[some]


def _image_at(images: np.ndarray | None, frame: int | None, some: Tensor) -> Tensor:
    """Return some pixels of one frame of an array; NaN without array or frame."""
    if images is None or frame is None:
        return torch.full((len(some),), torch.nan, dtype=torch.float64)
    return torch.from_numpy(images[frame].reshape(-1)[some.numpy()].astype(np.float64))


def _distance_at(recording: Recording, frame: int | None, some: Tensor, ray: Tensor) -> Tensor:
    """Return what some pixels of one frame measured along their rays; NaN where nothing."""
    depth = _image_at(recording.depth, frame, some)
    depth = torch.where(depth > 0, depth, torch.nan)
    return depth / ray[:, 2] if recording.depth_kind == "z" else depth


class Probe(NamedTuple):
    """One pattern.

    Attributes:
        name: For programs.
        trace: What the residuals do: it follows "the residuals".
        columns: What the residuals would be, shape (M, K); no unit is asked for.
    """

    name: str
    trace: str
    columns: Tensor


def _standard(values: Tensor) -> Tensor:
    return (values - values.mean()) / values.std().clamp(min=1e-12)


def _on_image(seen: MisfitPixels) -> tuple[Tensor, Tensor, Tensor]:
    x, y = (seen.ray[:, axis] / seen.ray[:, 2] for axis in (0, 1))
    return x, y, x * x + y * y


def _brightness(seen: MisfitPixels) -> Tensor | None:
    """Return the logarithm of the amplitude, standardised; None where it is not known."""
    if not bool(seen.amplitude.isfinite().all()):
        return None
    # The logarithm of no amplitude is infinite: it is cut at a thousandth of the median.
    return _standard(seen.amplitude.clamp(min=1e-3 * float(seen.amplitude.median())).log())


def _error(seen: MisfitPixels, *values: Tensor) -> Tensor:
    """Return what errors of the distance (M,) do to the residual, shape (M, K)."""
    return seen.cosine[:, None] * torch.stack(values, dim=1)


def finer_forms(seen: MisfitPixels) -> list[Probe]:
    """Return errors over distance, pixel and amplitude that are finer than those of a usual model.

    What a smooth term cannot follow leaves some of itself in every other probe.
    """
    u, (x, y, square), bright = _standard(seen.distance), _on_image(seen), _brightness(seen)
    place = x * y, square**2, x**3, y**3, x * x * y, x * y * y
    finely = "more finely than the model"
    found = [
        Probe("distance", f"follow the distance {finely}", _error(seen, u**4, u**5)),
        Probe("pixel", f"follow the place in the image {finely}", _error(seen, *place)),
    ]
    if bright is not None:
        trace = "follow the amplitude otherwise than the model"
        found.append(Probe("amplitude", trace, _error(seen, bright, bright**2)))
    return found


def probes(seen: MisfitPixels) -> list[Probe]:
    """Return the other probes that a recording allows."""
    (x, y, square), u, facing = _on_image(seen), _standard(seen.distance), -seen.cosine
    (s, t), when = seen.on_wall.unbind(dim=1), _standard(seen.frame.to(torch.float64))
    one, none, bright = torch.ones_like(x), torch.zeros_like(x), _brightness(seen)
    # Amplitude ratios are cut, so that single dark pixels do not decide.
    change = torch.where(seen.before.isfinite(), seen.before - seen.distance, 0.0)
    light = (seen.amplitude_before / seen.amplitude).clamp(max=20.0).nan_to_num()

    def of_phase(further: Tensor) -> Tensor:
        """Return the error by a weak signal of a longer path, in units of its share."""
        if seen.modulation_frequency is None:
            return further
        return torch.sin(phase_from_radial_distance(further, seen.modulation_frequency))

    def error(*values: Tensor) -> Tensor:
        return _error(seen, *values)

    def lens(*moves: tuple[Tensor, Tensor]) -> Tensor:
        return torch.stack([seen.moved_rays(*move) for move in moves], dim=1)

    tilted = "are those of image axes that are scaled or tilted"
    found = {
        "incidence": ("follow the angle of incidence", error(1 / facing - 1, (1 - facing) ** 2)),
        "order": ("follow the order of the frames", error(when, when**2)),
        "previous_frame": ("follow the frame before", error(change, light * of_phase(change))),
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
        "room": ("grow as light from all sides makes them", error(seen.distance**2 / facing)),
        # Light that the camera's mount sends back to the wall.
        "facing": (
            "are those of light between target and camera",
            error(of_phase(seen.distance) * facing / seen.distance**2),
        ),
    }
    if not seen.walls_estimated:
        found["plane"] = ("are those of planes elsewhere", torch.stack([one, s, t], dim=1))
    if seen.modulation_frequency is not None:
        # Four waves in one unambiguous range: of the third harmonic with four taps (Lange 2000).
        phase = 4 * phase_from_radial_distance(seen.distance, seen.modulation_frequency)
        found["circular"] = ("repeat over the distance", error(phase.sin(), phase.cos()))
    if bright is not None:
        ratio = seen.amplitude.median() / seen.amplitude.clamp(min=1e-12)
        trace = "follow amplitude and distance together"
        found["amplitude_by_distance"] = (trace, error(bright * u))
        trace = "are those of light that strayed in the lens"
        found["stray_light"] = (trace, error(ratio.clamp(max=20.0)))
    return [Probe(name, *own) for name, own in found.items()]


def find_misfit(seen: MisfitPixels, fit: Fit) -> Misfit | None:
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
    # The interval is that of the report.
    half = student_quantile(0.975, fit.covariance.degrees_of_freedom)
    half = half * fit.hand_eye_covariance.diagonal().clamp(min=0).sqrt()
    finer, others = finer_forms(seen), probes(seen)
    groups = _fitted(seen, fit, others, finer), _fitted(seen, fit, finer, [])
    # The probability is that of any probe by chance, over all that were tried (Bonferroni).
    tried = sum(len(group) for group in groups)
    for group in groups:
        judged = [
            Misfit(probe.name, probe.trace, min(1.0, tried * moved.p_value), moved.shift[:6])
            for probe, moved in group
        ]
        counting = [
            one
            for one in judged
            if one.p_value < 0.05
            and bool((one.twist.abs() > half).any())
            and max(one.shift, one.turn) > _LEAST
        ]
        if counting:
            return min(counting, key=lambda one: one.p_value)
    return None


def _fitted(
    seen: MisfitPixels, fit: Fit, tried: list[Probe], beside: list[Probe]
) -> list[tuple[Probe, Added]]:
    """Fit each probe beside the model and all of some others; those that tell nothing are left out.

    Their values are root mean squares of the errors that they stand for.
    """
    nuisances = [_unit(seen, one.columns) for one in beside]
    columns = [_unit(seen, one.columns) for one in tried]
    known = torch.cat([seen.jacobian, *nuisances], dim=1)
    every = torch.cat([known, *columns, seen.residual[:, None]], dim=1)
    products = pose_products(every, seen.pose[seen.frame], seen.weight.clamp(min=0))
    compared = AddedColumns(products, _prior(seen, fit, known.shape[1]))
    found, first = [], 0
    for probe, own in zip(tried, columns, strict=True):
        moved = compared(list(range(first, first + own.shape[1])))
        first += own.shape[1]
        if moved is not None and float(moved.values.abs().max()) < _LARGEST:
            found.append((probe, moved))
    return found


def _unit(seen: MisfitPixels, columns: Tensor) -> Tensor:
    """Scale columns to a root mean square error of the distance of 1."""
    size = (columns / seen.cosine[:, None]).square().mean(dim=0).sqrt()
    return columns / size.clamp(min=1e-12)


def assumptions(seen: MisfitPixels, fit: Fit, camera: CameraIntrinsics) -> tuple[Assumption, ...]:
    """Return what errors of the intrinsics and of measured planes would do.

    Args:
        seen: Some pixels beside the fitted model.
        fit: The fitted model, its hand-eye transform estimated.
        camera: As recorded.
    """
    (fx, _, _), (_, fy, _), _ = camera.matrix
    x, y, _ = _on_image(seen)
    one, none = torch.ones_like(x), torch.zeros_like(x)
    # Such errors remain after a careful calibration of the lens, and of a wall by touching it. With
    # a longer focal length rays come nearer the axis, with a shifted point they move the other way.
    errors = [
        ("focal_length", "focal length 0.1 % longer", -1e-3 * seen.moved_rays(x, y)),
        (
            "principal_point_right",
            "principal point 1 px further right",
            seen.moved_rays(-one / fx, none),
        ),
        (
            "principal_point_down",
            "principal point 1 px further down",
            seen.moved_rays(none, -one / fy),
        ),
    ]
    if not seen.walls_estimated:
        farther = torch.full_like(seen.residual, 1e-3)
        errors.append(("plane_offset", "d of all planes 1 mm larger", farther))
    columns = torch.stack([column for _, _, column in errors], dim=1)
    found = [
        Assumption(name, words, twist)
        for (name, words, _), twist in zip(errors, _moved(seen, fit, columns).T, strict=True)
    ]
    if not seen.walls_estimated:
        turned = _moved(seen, fit, math.radians(0.1) * seen.on_wall)
        # About the axis where the camera moves most.
        turned = turned @ torch.linalg.svd(turned[:3], full_matrices=False).Vh[0]
        found.append(Assumption("plane_tilt", "all planes turned by 0.1 deg", turned))
    return tuple(found)


def _moved(seen: MisfitPixels, fit: Fit, columns: Tensor) -> Tensor:
    """Return how far the hand-eye transform moves by each column, shape (6, K)."""
    weighted = seen.jacobian * seen.weight.clamp(min=0)[:, None]
    hessian = weighted.T @ seen.jacobian
    hessian = hessian + _prior(seen, fit, len(hessian)).hessian
    return -(Curvature(hessian).inverse @ (weighted.T @ columns))[:6]


def _prior(seen: MisfitPixels, fit: Fit, unknowns: int) -> NormalEquations:
    """Return the prior of the fit for all unknowns, by the share of the weight that was read."""
    zero = torch.zeros(unknowns, unknowns, dtype=torch.float64)
    none = NormalEquations(zero.sum(), zero.sum(dim=0), zero)
    if fit.total_prior is None:
        return none
    own = fit.total_prior.equations(fit.solution.parameters)
    share = seen.weight.sum() / fit.moments.gram[:, -1, -1].sum()
    return none.plus(NormalEquations(*(share * part for part in own)))
