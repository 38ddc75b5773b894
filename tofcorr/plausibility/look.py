"""What the checks look at: a thinned sample of a recording, its planes, alignment and residuals.

Everything is computed once and when it is asked for.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.alignment import (
    Alignment,
    Scene,
    align,
    align_with_free_walls,
    distinct,
    moments_of,
)
from tofcorr.plausibility.linear import (
    Estimate,
    LinearResiduals,
    brightness,
    by_conditions,
    by_phase,
    image_shape,
    places_on_wall,
    pose_drift,
)
from tofcorr.plausibility.mounting import FEWEST_FOR_STEP, CameraStep, Mounting
from tofcorr.spread import sigma_from_mad

PlaneUse = Literal["known", "unknown", "ignored"]
"""`known`: the planes recorded are used; `unknown`: a start for the fit; `ignored`: not used."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Some pixels of each frame, and the frames' rows: enough to judge, and read in a moment.

    F frames, P pixels of each, G pixels of a fixed grid.

    Attributes:
        data: The recordings.
        frames: Global numbers of the frames looked at, shape (F,).
        pixel: Flat index of each pixel in its image, shape (F, P).
        stored: Depth as stored, shape (F, P), float64, metres; NaN: not usable, or no pixel.
        amplitude: Shape (F, P); None if not recorded.
        grid: Depth as stored on the fixed grid, whatever the mask says, shape (F, G), float32.
        masked: Share of each image's pixels on the target by the mask, shape (F,); 1 without one.
        off_mask: As `stored`, but pixels off the mask, shape (F, P'); None without a mask.
        off_pixel: Flat indices of these, shape (F, P').
        noise: Standard deviation of one pixel along its ray, metres, from how far pixels are off
            the line through their neighbours in a row; NaN where no three neighbours are valid.
        noise_rms: The same as a root mean square, which noisy pixels raise.
    """

    data: Dataset
    frames: np.ndarray
    pixel: np.ndarray
    stored: np.ndarray
    amplitude: np.ndarray | None
    grid: np.ndarray
    masked: np.ndarray
    off_mask: np.ndarray | None
    off_pixel: np.ndarray | None
    noise: float
    noise_rms: float

    @property
    def recording(self) -> Recording:
        """The first recording, which stands for the camera."""
        return self.data.first

    @property
    def rays(self) -> np.ndarray:
        """Unit rays of all pixels of the image, shape (H W, 3)."""
        return self.data.ray_directions().numpy().reshape(-1, 3)

    def column(self, name: str) -> np.ndarray | None:
        """Return a column of the frames' tables for the frames looked at; None if one lacks it."""
        parts = [getattr(one.frames, name) for one in self.data.recordings]
        if any(part is None for part in parts):
            return None
        return np.concatenate(parts)[self.frames]


def read_sample(
    data: Dataset,
    pixels: int = 12_000,
    of_a_frame: tuple[int, int] = (24, 200),
    most_frames: int = 600,
    across: int = 12,
    jump: float = 0.15,
) -> Sample:
    """Read a few pixels of each frame, evenly spread over the pixels on the target.

    Args:
        data: The recordings.
        pixels: Looked at in all: a plane is then known to a tenth of the noise of one pixel, and 60
            frames are read and judged in well below 0.3 s.
        of_a_frame: The least and the most of one frame.
        most_frames: Looked at, evenly spaced: twenty minutes of poses, judged in about a second.
        across: Points across and down the fixed grid of each image.
        jump: Second difference of neighbours from which one of them is garbage, metres.
    """
    camera, total = data.first.camera, data.num_frames
    frames = np.unique(np.linspace(0, total - 1, min(total, most_frames)).astype(int))
    number = int(np.clip(pixels // len(frames), *of_a_frame))
    everywhere = _even(np.arange(camera.height * camera.width), number, camera.width)
    rows, columns = (
        np.unique(np.linspace(0, size - 1, across).astype(int))
        for size in (camera.height, camera.width)
    )
    grid_pixel = (rows[:, None] * camera.width + columns).ravel()
    rays = data.ray_directions().numpy().reshape(-1, 3)
    pixel, stored, bright, off, grid, share, second = [], [], [], [], [], [], []
    for recording, _, local in data.by_recording(frames):
        for k in local.tolist():
            image = recording.depth[k].reshape(-1)
            inside = np.arange(len(image))
            if recording.mask is not None:
                inside = np.flatnonzero(recording.mask[k].reshape(-1))
            chosen = _even(inside, number, camera.width)
            outside = np.setdiff1d(everywhere, inside, assume_unique=True)
            share.append(len(inside) / len(image))
            depth = _depth_at(image, chosen)
            if recording.amplitude is not None:
                bright.append(np.asarray(recording.amplitude[k].reshape(-1)[chosen], np.float64))
                if recording.saturation_amplitude is not None:
                    depth[bright[-1] >= recording.saturation_amplitude] = np.nan
            grid.append(np.array(image[grid_pixel]))
            pixel.append(chosen)
            stored.append(depth)
            off.append((outside, _depth_at(image, outside)))
            column = chosen % camera.width
            middle = chosen[(column > 0) & (column < camera.width - 1)]
            second.append(_off_neighbours(image, middle, rays, recording.depth_kind == "z"))
    differences = np.concatenate(second)
    differences = differences[np.abs(differences) < jump]
    # A second difference of independent values has six times their variance.
    noise = noise_rms = np.nan
    if len(differences):
        noise = sigma_from_mad(float(np.median(np.abs(differences)))) / 6**0.5
        noise_rms = float((np.mean(differences**2) / 6) ** 0.5)
    masked = any(recording.mask is not None for recording in data.recordings)
    return Sample(
        data=data,
        frames=frames,
        pixel=_padded(pixel, 0).astype(int),
        stored=_padded(stored, np.nan),
        amplitude=_padded(bright, np.nan) if len(bright) == len(frames) else None,
        grid=np.stack(grid),
        masked=np.array(share),
        off_mask=_padded([depth for _, depth in off], np.nan) if masked else None,
        off_pixel=_padded([place for place, _ in off], 0).astype(int) if masked else None,
        noise=noise,
        noise_rms=noise_rms,
    )


def _off_neighbours(
    image: np.ndarray, middle: np.ndarray, rays: np.ndarray, along_axis: bool
) -> np.ndarray:
    """Return twice the distance of pixels from the straight line through their neighbours, metres.

    A plane leaves nothing, however wide the pixels are and however it is tilted. Between narrow
    pixels this is the second difference of the distances. Along a ray r = a p + b q, the line
    through the neighbours' points on p and q lies at 1 / (a / distance_p + b / distance_q).
    """
    p, r, q = (rays[middle + step] for step in (-1, 0, 1))
    at_p, at_r, at_q = (
        _depth_at(image, middle + step) / (ray[:, 2] if along_axis else 1.0)
        for step, ray in ((-1, p), (0, r), (1, q))
    )
    between = (p * q).sum(1)
    along_p, along_q = (p * r).sum(1), (q * r).sum(1)
    scale = 1 - between**2
    a, b = (along_p - between * along_q) / scale, (along_q - between * along_p) / scale
    return 2 * (1 / (a / at_p + b / at_q) - at_r)


def _depth_at(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    depth = np.asarray(image[pixel], dtype=np.float64)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _even(pixels: np.ndarray, number: int, width: int) -> np.ndarray:
    """Return about `number` of some pixels, spread over rows and columns without a period."""
    if len(pixels) <= number:
        return pixels
    step = len(pixels) / number
    # Steps that the width divides would take the same columns of every row.
    if width > 1 and abs(step / width - round(step / width)) < 0.5 / number:
        step *= 1 - 1.5 / width
    chosen = np.unique((np.arange(0, len(pixels) / step) * step).astype(int))
    return pixels[chosen[chosen < len(pixels)]]


def _padded(parts: list[np.ndarray], filling: float) -> np.ndarray:
    joined = np.full((len(parts), max(1, *map(len, parts))), filling, dtype=np.float64)
    for row, part in zip(joined, parts, strict=True):
        row[: len(part)] = part
    return joined


@dataclass(frozen=True, eq=False)
class FramePlanes:
    """The plane of each frame in the camera frame, by its own points.

    Attributes:
        normal: Unit normals on the camera's side, shape (F, 3).
        on_plane: Which pixels lie on it, shape (F, P), bool.
        flatness: Root mean square distance of these to it, shape (F,), metres.
        off_by: Distance along the ray of every pixel to it, shape (F, P), metres; NaN: no pixel.
        known: Whether a frame's pixels determine its plane, shape (F,), bool.
    """

    normal: np.ndarray
    on_plane: np.ndarray
    flatness: np.ndarray
    off_by: np.ndarray
    known: np.ndarray


def frame_planes(
    rays: np.ndarray,
    distance: np.ndarray,
    *,
    spread: float = 0.02,
    fewest: int = 6,
    sigmas: float = 4.0,
    tolerance: float = 0.02,
) -> FramePlanes:
    """Fit a plane to each frame: the best of some triples of pixels, then least squares near it.

    Args:
        rays: Unit rays, shape (F, P, 3).
        distance: Along the rays, shape (F, P), metres; NaN: not usable.
        spread: Least standard deviation of a frame's rays across its two directions, radians; below
            it the direction of the plane is not known: at 1 m it makes a base of 2 cm.
        fewest: Pixels of a plane that can be judged: three determine one.
        sigmas: A pixel is on its frame's plane within so many robust standard deviations,
        tolerance: or this distance, metres: errors of a camera bend a wall by a centimetre.
    """
    valid = np.isfinite(distance)
    points = rays * np.where(valid, distance, 0.0)[..., None]
    _, extent, _ = _principal(rays, valid)
    known = (extent[:, 1] > spread**2) & (valid.sum(1) >= fewest)
    normal, offset = _best_triples(rays, points, distance, valid)
    on_plane = valid
    for _ in range(2):
        off_by = distance + offset[:, None] / _cosine(rays, normal[:, None])[:, 0]
        sigma = sigma_from_mad(_median(np.abs(off_by)))
        on_plane = np.abs(off_by) <= np.maximum(sigmas * sigma, tolerance)[:, None]
        on_plane[~known] = valid[~known]
        mean, _, directions = _principal(points, on_plane)
        # The camera is the origin; the normal points to its side.
        away = (directions[..., 0] * mean).sum(-1) > 0
        normal = directions[..., 0] * np.where(away, -1.0, 1.0)[:, None]
        offset = -(normal * mean).sum(-1)
    off_by = distance + offset[:, None] / _cosine(rays, normal[:, None])[:, 0]
    height = np.einsum("fpa,fa->fp", points, normal) + offset[:, None]
    square = np.where(on_plane, height**2, 0.0).sum(1) / np.maximum(on_plane.sum(1), 1)
    return FramePlanes(normal, on_plane, np.sqrt(square), off_by, known)


def _principal(
    vectors: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of the chosen vectors (F, P, 3), and variances and directions about it."""
    count = np.maximum(chosen.sum(1), 1)[:, None]
    mean = np.where(chosen[..., None], vectors, 0.0).sum(1) / count
    centred = np.where(chosen[..., None], vectors - mean[:, None], 0.0)
    covariance = np.einsum("fpa,fpb->fab", centred, centred) / count[..., None]
    values, directions = np.linalg.eigh(covariance)
    return mean, values, directions


def _best_triples(
    rays: np.ndarray, points: np.ndarray, distance: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane through three pixels, of 40 tried the one that most pixels agree with.

    With 40 % garbage, one of 40 triples is free of it with a probability of 1 - (1 - 0.6^3)^40 =
    0.99994.
    """
    frames = np.arange(len(rays))
    places = np.random.default_rng(0).uniform(size=(len(rays), 40, 3))
    order = np.argsort(~valid, axis=1, kind="stable")
    rank = (places * np.maximum(valid.sum(1), 1)[:, None, None]).astype(int)
    corners = points[frames[:, None, None], order[frames[:, None, None], rank]]
    across = corners[:, :, 1:] - corners[:, :, :1]
    normal = np.cross(across[:, :, 0], across[:, :, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    offset = -(normal * corners[:, :, 0]).sum(-1)
    error = np.abs(-offset[..., None] / _cosine(rays, normal) - distance[:, None])
    best = _median(error).argmin(1)
    return normal[frames, best], offset[frames, best]


def _cosine(rays: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the cosine of rays (F, P, 3) with normals (F, T, 3), none of it zero: (F, T, P)."""
    cosine = np.einsum("fta,fpa->ftp", normal, rays)
    return np.where(np.abs(cosine) < 1e-6, 1e-6, cosine)


def _median(values: np.ndarray) -> np.ndarray:
    """Return the lower median of the last axis without NaN; infinity where there is no value."""
    ordered = np.sort(values, axis=-1)  # NaN goes last.
    count = np.isfinite(values).sum(-1)
    middle = np.maximum((count - 1) // 2, 0)[..., None]
    return np.where(count > 0, np.take_along_axis(ordered, middle, axis=-1)[..., 0], np.inf)


@dataclass(frozen=True, eq=False)
class Look:
    """A sample of a recording, with planes and alignments computed on demand.

    Attributes:
        sample: Some pixels of each frame.
        planes: What the command does with the recorded planes.
        fits: Whether the command fits a model; `check` does not.
    """

    sample: Sample
    planes: PlaneUse = "known"
    fits: bool = True

    @property
    def poses(self) -> np.ndarray:
        """world_from_tool of the frames looked at, shape (F, 4, 4), metres."""
        return np.asarray(self.sample.column("world_from_tool"))

    @cached_property
    def rays(self) -> np.ndarray:
        """Unit rays of the sample's pixels, shape (F, P, 3)."""
        return self.sample.rays[self.sample.pixel]

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance along the rays, shape (F, P), metres; NaN: not usable."""
        return self._along_rays(self.sample.stored, self.rays)

    def _along_rays(self, stored: np.ndarray, rays: np.ndarray) -> np.ndarray:
        return stored / rays[..., 2] if self.sample.recording.depth_kind == "z" else stored

    @cached_property
    def own(self) -> FramePlanes:
        """The plane of each frame by its own points."""
        return frame_planes(self.rays, self.distance)

    @cached_property
    def usable(self) -> np.ndarray:
        """Which frames have a usable pixel, shape (F,), bool."""
        return np.asarray(self.own.on_plane.any(1) & np.isfinite(self.distance).any(1))

    @property
    def frames(self) -> np.ndarray:
        """Global numbers of the frames of `scene`."""
        return self.sample.frames[self.usable]

    @cached_property
    def flatness(self) -> float:
        """Median distance of a frame's points to their own plane, metres; 0 for single rays."""
        known = self.own.flatness[self.own.known]
        return float(np.median(known)) if len(known) else 0.0

    @cached_property
    def scene(self) -> Scene:
        """Poses and planes as recorded, points as measured; frames without a pixel left out."""
        return self._scene(self.rays, self.distance, self.own)

    def with_images(self, stored: np.ndarray, pixel: np.ndarray) -> Scene:
        """Return the scene if other depths had been measured, at other pixels."""
        rays = self.sample.rays[pixel]
        distance = self._along_rays(stored, rays)
        return self._scene(rays, distance, frame_planes(rays, distance))

    def _scene(self, rays: np.ndarray, distance: np.ndarray, own: FramePlanes) -> Scene:
        whole = Scene(
            poses=self.poses,
            normal=np.asarray(self.sample.column("normal_world")),
            offset=np.asarray(self.sample.column("offset")),
            moments=moments_of(rays, distance, own.on_plane & np.isfinite(distance)),
            own_normal=own.normal,
            known=own.known,
            moves=self.sample.data.moves,
            guess=np.asarray(self.sample.recording.tool_from_camera, dtype=np.float64),
        )
        return whole.some(self.usable)

    @cached_property
    def as_given(self) -> Alignment | None:
        """The alignment as the command would see it; None where nothing can be aligned."""
        return None if self.planes == "ignored" else self.aligned(self.scene)

    @property
    def given(self) -> Alignment:
        """The same, where there is one."""
        assert self.as_given is not None
        return self.as_given

    def aligned(self, scene: Scene) -> Alignment | None:
        """Return the alignment of a scene, its walls free where the command takes them so."""
        if not len(scene.poses):
            return None
        return align_with_free_walls(scene) if self.planes == "unknown" else align(scene)

    @cached_property
    def linear(self) -> LinearResiduals | None:
        """Residuals near the alignment of the frames with a plane of their own.

        None where the recorded planes are not taken as right.
        """
        given, known, sample = self.as_given, self.scene.known, self.sample
        if given is None or self.planes != "known" or not known.any():
            return None
        chosen = np.flatnonzero(self.usable)[known]
        seen = replace(given, rms=given.rms[known], angle=given.angle[known])
        used = (self.own.on_plane & np.isfinite(self.distance))[chosen]
        bright = None
        if sample.amplitude is not None:
            any_known = np.isfinite(sample.amplitude).any()
            typical = float(np.nanmedian(sample.amplitude)) if any_known else 1.0
            bright = brightness(np.nan_to_num(sample.amplitude, nan=typical), typical)[chosen]
        rays, distance = self.rays[chosen], self.distance[chosen]
        return LinearResiduals(self.scene.some(known), seen, rays, distance, used, bright)

    @cached_property
    def of_camera(self) -> LinearResiduals:
        """The same, with errors that follow conditions and phase.

        A camera whose distances follow its integration time by centimetres is to be calibrated, and
        no reason to doubt a recording that says so.
        """
        problem, sample = self.linear, self.sample
        assert problem is not None
        conditions = by_conditions(sample.column, len(sample.frames))[self.usable]
        circular = by_phase(problem, sample.recording.modulation_frequency)
        along = [conditions[self.scene.known][:, None], circular]
        return problem.with_columns(
            np.concatenate([problem.cosine[..., None] * one for one in along], axis=-1)
        )

    @cached_property
    def shape(self) -> dict[str, Estimate] | None:
        """Errors of the header and bends of the target; None where they cannot be estimated."""
        if self.linear is None:
            return None
        return image_shape(self.of_camera, self.sample.recording.depth_kind)

    @property
    def half_width(self) -> float:
        """Half of what is seen of the target, metres."""
        s, t = places_on_wall(self.of_camera)
        used = self.of_camera.used
        return float(np.quantile(np.hypot(s[used], t[used]), 0.9)) if used.any() else 0.0

    @cached_property
    def drift(self) -> Estimate | None:
        """How far poses or walls drift; None where they do not, or it cannot be estimated."""
        return None if self.linear is None else pose_drift(self.linear)

    @cached_property
    def step(self) -> CameraStep | None:
        """A moment at which the camera surely moved on the tool; None: there is none to be told."""
        return None if self._mounting is None else self._mounting.moment()

    @cached_property
    def parts(self) -> CameraStep | None:
        """Frames in any order whose camera sits elsewhere on the tool; None: none to be told."""
        return None if self._mounting is None else self._mounting.parts()

    @cached_property
    def _mounting(self) -> Mounting | None:
        """None where there are too few distinct poses, or a drift explains what it would find."""
        if self.linear is None or not self.scene.moves or self.drift is not None:
            return None
        scene = self.linear.scene
        return Mounting(self.of_camera) if len(distinct(scene.poses)) >= FEWEST_FOR_STEP else None

    @cached_property
    def _explained(self) -> Estimate | None:
        """What explains most of the residuals, as far as that can be told."""
        return self.drift or (None if self.shape is None else self.shape["kind"])

    @cached_property
    def rms(self) -> np.ndarray:
        """Distance of each frame's points to its plane, shape (F,), metres.

        Without what errors of a camera, of its header and a steady drift explain, where that can
        be told.
        """
        left = self.given.rms.copy()
        if self.linear is not None and self._explained is not None:
            left[self.scene.known] = self.linear.frame_rms(self._explained.left)
        return left

    @cached_property
    def planes_off(self) -> np.ndarray | None:
        """How far each frame's plane is from the recorded one, shape (F,), metres; NaN: unknown.

        Root mean square over its pixels, without what errors of a camera, of its header and a
        steady drift explain; None where that cannot be told.
        """
        if self.linear is None or self._explained is None:
            return None
        off = np.full(len(self.scene.poses), np.nan)
        off[self.scene.known] = self.linear.frame_planes_off(self._explained.left)
        return off
