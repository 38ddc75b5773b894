"""What the checks look at: a thinned sample of a recording, its planes, alignment and residuals.

Everything is computed once and when it is asked for.
"""

import math
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np

from tofcorr.conditions import CONDITIONS
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.alignment import (
    Alignment,
    Scene,
    align,
    align_with_free_walls,
)
from tofcorr.plausibility.finding import LARGE_CONSTANT
from tofcorr.plausibility.linear import (
    Estimate,
    Late,
    LinearResiduals,
    by_conditions,
    by_phase,
    image_shape,
    lateness,
    pose_drift,
)

PlaneUse = Literal["known", "unknown", "ignored"]
"""`known`: the planes recorded are used; `unknown`: a start for the fit; `ignored`: not used."""


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


def _depth_at(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    depth = np.asarray(image[pixel], dtype=np.float64)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _padded(parts: list[np.ndarray], filling: float) -> np.ndarray:
    joined = np.full((len(parts), max(1, *map(len, parts))), filling, dtype=np.float64)
    for row, part in zip(joined, parts, strict=True):
        row[: len(part)] = part
    return joined


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


def _noise_of(differences: np.ndarray) -> tuple[float, float]:
    """Return a pixel's noise by second differences of neighbours, metres: robust, and as an RMS.

    Where they differ by more than errors of a camera, and ten times as much as usual, one of them
    is garbage: a dark pixel has ten times the noise.
    """
    differences = np.abs(differences[np.isfinite(differences)])
    if not len(differences):
        return np.nan, np.nan
    usual = float(np.median(differences))
    differences = differences[differences < max(LARGE_CONSTANT, 10 * usual)]
    # A second difference of independent values has six times their variance.
    noise = sigma_from_mad(float(np.median(differences))) / 6**0.5
    return noise, float((np.mean(differences**2) / 6) ** 0.5)


class Look:
    """Some pixels of each frame, and the frames' rows: enough to judge, and read in a moment.

    Args:
        data: The recordings.
        planes: What the command does with the recorded planes.
        fits: Whether the command fits a model; `check` does not.

    Attributes:
        recording: The first recording, which stands for the camera.
        rays: Unit rays of all pixels of the image, shape (H W, 3).
        sampled: Global numbers of the F frames looked at.
        poses: world_from_tool of these frames, shape (F, 4, 4), metres.
        group: Number of each frame's repeats: frames that differ by noise alone share it, (F,).
        pixel: Flat index of P pixels in the image of each, on the target by its mask, shape (F, P).
        stored: Depth as stored, shape (F, P), float64, metres; NaN: not usable, or no pixel.
        amplitude: Shape (F, P); None if not recorded.
        masked: Share of each image's pixels on the target by the mask, shape (F,); 1 without one.
        off_mask: As `stored`, but pixels off the mask, shape (F, P'); None without a mask.
        off_pixel: Flat indices of these, shape (F, P').
        noise: Standard deviation of one pixel along its ray, metres, from how far pixels are off
            the line through their neighbours in a row; NaN where no three neighbours are valid.
        noise_rms: The same as a root mean square, which noisy pixels raise.
        usable: Which frames have a usable pixel, shape (F,), bool.
        frames: Global numbers of these.
        scene: Their poses and planes as recorded, and their points as measured.
        flatness: Median distance of a frame's points to their own plane, metres; 0 for single rays.
    """

    def __init__(self, data: Dataset, planes: PlaneUse = "known", *, fits: bool = True) -> None:
        self.data, self.planes, self.fits = data, planes, fits
        self.recording, total = data.first, data.num_frames
        self.rays = data.ray_directions().numpy().reshape(-1, 3)
        # Twenty minutes of poses, judged in about a second.
        self.sampled = np.unique(np.linspace(0, total - 1, min(total, 600)).astype(int))
        self.poses = data.column("world_from_tool").numpy()[self.sampled]
        self.group = data.repeat_groups()[self.sampled]
        # A plane is then known to a tenth of the noise of one pixel, and 60 frames are read and
        # judged in well below 0.3 s.
        self._read(int(np.clip(12_000 // len(self.sampled), 24, 200)))
        whole = Scene(data, self.sampled, self.rays[self.pixel], self.stored)
        self.usable = np.asarray(whole.on_plane.any(1))
        self.frames, self.scene = self.sampled[self.usable], whole.some(self.usable)
        flatness = self.scene.flatness[self.scene.known]
        self.flatness = float(np.median(flatness)) if len(flatness) else 0.0

    def _read(self, number: int) -> None:
        """Read so many pixels of each frame."""
        width, rays = self.recording.camera.width, self.rays
        everywhere = _even(np.arange(len(rays)), number, width)
        pixel, stored, bright, off_pixel, off, share, second = ([] for _ in range(7))
        for recording, _, local in self.data.by_recording(self.sampled):
            for k in local.tolist():
                image, inside = recording.depth[k].reshape(-1), np.arange(len(rays))
                if recording.mask is not None:
                    inside = np.flatnonzero(recording.mask[k].reshape(-1))
                chosen = _even(inside, number, width)
                depth = _depth_at(image, chosen)
                if recording.amplitude is not None:
                    bright.append(recording.amplitude[k].reshape(-1)[chosen].astype(np.float64))
                    if recording.saturation_amplitude is not None:
                        depth[bright[-1] >= recording.saturation_amplitude] = np.nan
                pixel.append(chosen)
                stored.append(depth)
                share.append(len(inside) / len(rays))
                off_pixel.append(np.setdiff1d(everywhere, inside, assume_unique=True))
                off.append(_depth_at(image, off_pixel[-1]))
                column = chosen % width
                middle = chosen[(column > 0) & (column < width - 1)]
                second.append(_off_neighbours(image, middle, rays, recording.depth_kind == "z"))
        self.pixel, self.stored = _padded(pixel, 0).astype(int), _padded(stored, np.nan)
        self.amplitude = _padded(bright, np.nan) if len(bright) == len(stored) else None
        self.masked = np.array(share)
        has_mask = any(recording.mask is not None for recording in self.data.recordings)
        self.off_mask = _padded(off, np.nan) if has_mask else None
        self.off_pixel = _padded(off_pixel, 0).astype(int)
        self.noise, self.noise_rms = _noise_of(np.concatenate(second))

    @cached_property
    def neighbours(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The frames before and after those of the linear residuals, of F.

        The first and the last frame of a recording stand for those that it does not have.

        Returns:
            world_from_tool of the frame before, and of the one after, shape (F, 4, 4), metres;
            normal and offset of the plane of the one before, in the world, shape (F, 4), metres.
        """
        ends = np.cumsum([0, *(one.num_frames for one in self.data.recordings)])
        seen, poses = self.frames[self.scene.known], self.data.column("world_from_tool").numpy()
        own = np.searchsorted(ends, seen, side="right")
        before, after = ((seen + k).clip(ends[own - 1], ends[own] - 1) for k in (-1, 1))
        normal, offset = (self.data.column(k).numpy() for k in ("normal_world", "offset"))
        return poses[before], poses[after], np.column_stack([normal, offset])[before]

    def condition(self, name: str) -> np.ndarray:
        """Return a condition of the frames looked at, shape (F,); NaN: unknown."""
        return self.data.conditions(self.sampled)[:, CONDITIONS.index(name)].numpy()

    def with_images(self, stored: np.ndarray, pixel: np.ndarray) -> Scene:
        """Return the scene if these depths (F, P) had been measured, at these pixels."""
        return Scene(self.data, self.sampled, self.rays[pixel], stored).some(self.usable)

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
        given, known = self.as_given, self.scene.known.any()
        return self.near(given) if given and self.planes == "known" and known else None

    def near(self, found: Alignment) -> LinearResiduals:
        """Return the same near any alignment of the scene."""
        known = self.scene.known
        seen = replace(found, rms=found.rms[known], angle=found.angle[known])
        amplitude = None if self.amplitude is None else self.amplitude[self.usable][known]
        return LinearResiduals(self.scene.some(known), seen, amplitude)

    @cached_property
    def of_camera(self) -> LinearResiduals:
        """The same, with errors that follow conditions and phase.

        A camera whose distances follow its integration time by centimetres is to be calibrated, and
        no reason to doubt a recording that says so.
        """
        assert self.linear is not None
        seen = self.frames[self.scene.known]
        conditions = by_conditions(self.data.conditions(seen).numpy())
        circular = by_phase(self.linear, self.recording.modulation_frequency)
        along = [self.linear.cosine[..., None] * one for one in (conditions[:, None], circular)]
        return self.linear.with_columns(np.concatenate(along, axis=-1))

    @cached_property
    def shape(self) -> dict[str, Estimate] | None:
        """Errors of the header and bends of the target; None where they cannot be estimated."""
        if self.linear is None:
            return None
        return image_shape(self.of_camera, self.recording.depth_kind)

    @cached_property
    def drift(self) -> Estimate | None:
        """How far poses or walls drift; None where they do not, or it cannot be estimated."""
        return None if self.linear is None else pose_drift(self.of_camera)

    @cached_property
    def late(self) -> Late | None:
        """Whether poses and images are of different moments; None where it cannot be told."""
        return None if self.linear is None else lateness(self.of_camera, *self.neighbours)

    @cached_property
    def _left(self) -> np.ndarray | None:
        """What is left of the residuals by what explains most; None where that cannot be told."""
        others = self.late and self.late[2], self.shape["kind"] if self.shape else None
        return next((one.left for one in (self.drift, *others) if one), None)

    @cached_property
    def rms(self) -> np.ndarray:
        """Distance of each frame's points to its plane, shape (N,), metres.

        Without what errors of a camera, of its header and a steady drift explain, where that can
        be told.
        """
        rms = self.given.rms.copy()
        if self.linear is not None and self._left is not None:
            rms[self.scene.known] = self.linear.frame_rms(self._left)
        return rms

    @cached_property
    def planes_off(self) -> np.ndarray | None:
        """How far each frame's plane is from the recorded one, shape (N,), metres; NaN: unknown.

        Root mean square over its pixels, without what errors of a camera, of its header and a
        steady drift explain; None where that cannot be told.
        """
        if self.linear is None or self._left is None:
            return None
        off = np.full(len(self.scene.poses), np.nan)
        off[self.scene.known] = self.linear.frame_planes_off(self._left)
        return off

    def numbers(self, *, aligned: bool) -> dict[str, float]:
        """Return what was measured; the focal length if its standard error is below 3 %."""
        stored = self.stored[np.isfinite(self.stored)]
        found: dict[str, float] = {
            "frames": float(self.data.num_frames),
            "median distance, m": float(np.median(stored)) if len(stored) else math.nan,
            "extent of the poses, m": float(np.linalg.norm(np.ptp(self.poses[:, :3, 3], axis=0))),
            "pixels on the target, %": 100 * float(self.masked.mean()),
            "noise of a pixel, mm": 1e3 * self.noise,
        }
        if aligned:
            found["flatness of a frame's points, mm"] = 1e3 * self.flatness
            if (given := self.as_given) is not None:
                found["distance to the planes after alignment, mm"] = 1e3 * given.misfit
                found["angle to the planes after alignment, deg"] = math.degrees(
                    given.typical_angle
                )
                found["distances too long by, mm"] = 1e3 * given.constant
            if self.shape is not None and 100 * (focal := self.shape["focal"]).size_error < 3:
                found["focal length should change by, %"] = 100 * float(focal.value[0])
                found["standard error of that change, %"] = 100 * focal.size_error
        return {name: value for name, value in found.items() if math.isfinite(value)}
