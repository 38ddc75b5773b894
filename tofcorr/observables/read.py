"""Reads a recording once and keeps what noise, missing pixels and amplitude are measured from."""

from itertools import product

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from tofcorr.data.recording import Recording, iterate_frames, repeats_of
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import SAME_BRIGHTNESS, SECOND_DIFFERENCE, SPACING, tiles_of
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

LAGS, AXES = (1, 2), (1, 0)
"""Distances of the neighbours whose correlation is estimated, pixels: two tell how fast it falls,
and with it the width of a filter. Axes of an image (H, W): along a row, and along a column."""

FEWEST_PIXELS = 100
"""Valid pixels that an image needs for a surface, of ten coefficients, and a bin of brightness for
a variance: it is then known to 14 %."""
# Deviations beyond this many robust standard deviations of pixels of their brightness are no noise:
# normal noise of an image never reaches it, mixed pixels at edges do.
_CLIP = 6.0
# Pixels beyond this many robust standard deviations, and those next to them, may see an edge: 1 of
# 16 000 pixels with normal noise does. Chosen.
_EDGE = 4.0
# Frames of a pose and pixels of it that are read at most. Chosen to bound time and memory: 30 give
# the variance of a pixel to 26 %, and 60 poses 240 000 rows, whose mean is known to 0.3 %.
_MOST_REPEATS, _MOST_OF_POSE = 30, 4000


class Observed:
    """What was read of one recording.

    Args:
        recording: Any recording, real or simulated.

    Raises:
        CalibrationDataError: No image has 100 usable pixels, or a frame breaks the format.

    Attributes:
        recording: Where it comes from.
        table: The sample of pixels: one row for each of them in each pose, with the fields

            pose, pixel: number of the pose; flat index in the image;
            distance, cosine: to the plane of the images, metres, and of the angle of incidence;
            signal: light returned relative to the same target at 1 m, seen head-on: cos / d^2;
            target: number of the target's name, in alphabetical order of all names;
            amplitude: mean over frames with a distance, counts;
            raw_amplitude: mean over all frames, as recorded;
            of_repeats: variance over repeated frames, m^2, of pixels that see one surface;
            of_neighbours: mean square of their scaled second differences, m^2;
            of_nearest: mean half square of the differences to nearest pixels of like brightness;
            frames, missing, saturated: in how many frames the pixel looks at the target, has no
            distance, is saturated.

            A field is NaN where it is unknown.
        repeats: Number of frames of each pose, shape (P,).
        temporal: Of deviations from the mean of repeated frames: sums of products of neighbours,
            their squares, and numbers, in each pose, along `AXES` at `LAGS`: shape (P, 3, 2, 2).
        within: Half squares of differences of neighbours in one image, squares of second
            differences there, and numbers, likewise; without the pattern and the edges of squares.
        pattern: Variance of what the residuals of different poses share, m^2; of a single pose,
            what its frames share.
        between_frames: Half the squared differences of frames one and two apart, of each pose,
            summed over tiles of the image, shape (2, T), m^2.
        map_missing: How often each pixel was missing, shape (H, W).
        map_frames: In how many frames it looked at the target, shape (H, W).
        losing_poses: How many poses miss a pixel.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        names = sorted(set(recording.frames.target.tolist()))
        shape = (recording.camera.height, recording.camera.width)
        self.map_missing, self.map_frames = np.zeros((2, *shape))
        tables, sums, counts = ([] for _ in range(3))
        self.between_frames: list[np.ndarray] = []
        fit = _SurfaceFit(recording.camera)
        poses, shared = repeats_of(recording), _BetweenPoses(shape)
        for frames in poses:
            shared.add(_PoseImages(recording, frames[:_MOST_REPEATS], fit))
        self.pattern = shared.variance()
        for number, frames in enumerate(poses):
            images = _PoseImages(recording, frames[:_MOST_REPEATS], fit)
            residual = images.residual
            images.compare(shared.without(images))
            sums.append(_of_neighbours(images))
            if len(poses) == 1:
                self.pattern = _repeated_variance(residual)
            self.between_frames.append(_frame_differences(residual))
            target = str(recording.frames.target[frames[0]])
            tables.append(_rows(images, number, names.index(target), shape))
            self.map_missing[images.place] += images.missing.sum(0)
            self.map_frames[images.place] += images.on_target.sum(0)
            counts.append([len(residual), images.missing.any()])
        self.table = np.concatenate(tables).view(np.recarray)
        if not np.isfinite(self.table.distance).any():
            raise CalibrationDataError(f"{recording.path}: no image has 100 usable target pixels.")
        self.repeats, losing = np.array(counts).T
        self.losing_poses = int(losing.sum())
        self.temporal, self.within = np.stack(sums, axis=1)


class _PoseImages:
    """The R frames of one pose, cut to the rectangle of h x w pixels that holds the target.

    Args:
        recording: The recording.
        frames: Numbers of the frames, shape (R,).
        fit: Fits surfaces to images of its camera.

    Attributes:
        residual: Measured distance less the smooth surface of the mean image, and less the offset
            of the frame, without gross outliers, shape (R, h, w), metres; NaN where not usable.
        deviation: Of it from its mean over the frames, shape (R, h, w), metres; NaN at edges.
        edge: Where the mean image shows edges, the pattern being in it, shape (h, w), bool.
        weight: Of the pixels, by the noise of their brightness, shape (h, w), 1/m^2.
        amplitude: Counts, shape (R, h, w), as recorded; None if not recorded.
        on_target: Where the pixels look at the target, shape (R, h, w), bool.
        missing: Pixels on the target without a distance, shape (R, h, w), bool.
        saturated: Pixels on the target at or above the stated saturation, shape (R, h, w), bool.
        distance: To the plane of the images, shape (h, w), metres; NaN where unknown.
        cosine: Of the angle of incidence on that plane, shape (h, w); NaN where unknown.
        varying: What neighbours are compared by, shape (R, h, w), metres; NaN at edges.
        second: Its second differences by axis, as of `second_differences`.
        place: Rows and columns of the rectangle.
    """

    def __init__(self, recording: Recording, frames: np.ndarray, fit: "_SurfaceFit") -> None:
        batches = list(iterate_frames(recording, frames))
        valid = torch.cat([batch.valid for batch in batches]).numpy()
        mask = recording.read("mask", frames)
        on_target = np.ones_like(valid) if mask is None else mask.astype(bool)
        sides = [np.flatnonzero(on_target.any(axes)) for axes in ((0, 2), (0, 1))]
        rows, columns = (  # The smallest rectangle that holds the target; all where there is none.
            slice(int(seen[0]), int(seen[-1]) + 1) if len(seen) else slice(0, size)
            for seen, size in zip(sides, valid.shape[1:], strict=True)
        )
        self.place, cut = (rows, columns), (slice(None), rows, columns)
        self.on_target, self.amplitude = on_target[cut], None
        distance = torch.cat([batch.radial_distance[cut] for batch in batches]).numpy()
        self.saturated = np.zeros_like(self.on_target)
        if recording.amplitude is not None:
            strengths = [b.amplitude[cut] for b in batches if b.amplitude is not None]
            self.amplitude = torch.cat(strengths).numpy()
            if recording.saturation_amplitude is not None:
                full = self.amplitude >= recording.saturation_amplitude
                self.saturated = self.on_target & full
            self.amplitude[~np.isfinite(self.amplitude)] = np.nan
        self.missing = self.on_target & ~(np.isfinite(distance) & (np.nan_to_num(distance) > 0))
        usable = np.where(valid[cut], distance, np.nan)
        mean = known_mean(usable)
        of_mean, self.distance, self.cosine = fit(mean, self.place)
        around = usable - mean
        if len(usable) > 1:  # Each frame's own offset.
            known = [one[np.isfinite(one)] for one in around]
            offsets = [np.median(one) if len(one) else 0.0 for one in known]
            around = around - np.array(offsets)[:, None, None]
        # Each by its own spread: else a pixel that is far off in all frames would lose its noise.
        still, self.weight = _clipped(of_mean[None], self.amplitude)
        self.residual = _clipped(around, self.amplitude)[0] + still
        self.edge = self._edges(still)

    def compare(self, varying: np.ndarray) -> None:
        """Take what changes from pose to pose, (R, h, w), as what neighbours are compared by."""
        self.deviation = self.residual - known_mean(self.residual)
        edge = self._edges(self.deviation, varying)
        self.deviation[:, edge], self.varying = np.nan, np.where(edge, np.nan, varying)
        self.second = {k: second_differences(self.varying, self.amplitude, k) for k in AXES}

    def _edges(self, *residuals: np.ndarray) -> np.ndarray:
        """Return the pixels that see two surfaces or squares, or are next to one that does, (h, w).

        They have errors of their own. Bright and dark meet there, or one of the residuals, each
        (R, h, w) or (1, h, w), is far larger than at pixels as bright. None: too few others are
        left.
        """
        far = [(np.abs(r) > _EDGE * _spread(r, self.amplitude)).any(0) for r in residuals]
        edge = np.asarray(maximum_filter(np.any(far, axis=0), 3), dtype=bool)
        if self.amplitude is not None:
            mean = known_mean(self.amplitude)
            high, low = (np.asarray(f(mean, 3)) for f in (maximum_filter, minimum_filter))
            edge |= high - low > SAME_BRIGHTNESS * (high + low)
        others = np.isfinite(self.residual).any(0) & ~edge
        return edge & (others.sum() >= FEWEST_PIXELS)


class _SurfaceFit:
    """Fits smooth surfaces to the images of one camera.

    On a plane, 1/z is linear in x/z and y/z. A cubic in both follows the plane and every smooth
    error, so that noise, patterns and edges are left.

    Args:
        camera: The camera intrinsics.
    """

    def __init__(self, camera: CameraIntrinsics) -> None:
        self._rays = ray_directions(camera).numpy()
        self._z = self._rays[..., 2]
        x, y = (self._rays[..., axis] / self._z for axis in (0, 1))
        self._scale = max(float(np.abs(x).max()), float(np.abs(y).max())) or 1.0
        x, y = x / self._scale, y / self._scale
        # A plane first, then what smooth errors add to it.
        powers = [(total - k, k) for total in range(4) for k in range(total + 1)]
        self._basis = np.stack([x**a * y**b for a, b in powers])

    def __call__(
        self, distance: np.ndarray, place: tuple[slice, slice]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the surface to a part of an image.

        Args:
            distance: Radial distances, shape (h, w), metres; NaN where they do not count.
            place: Where the part lies in the image.

        Returns:
            Measured minus smooth distance along the ray, metres, NaN where not valid; the distance
            of the plane of the image along the ray, metres, also where none was measured; the
            cosine of the angle of incidence on it; NaN throughout where fewer than 100 pixels are
            valid. Shape (h, w) each.
        """
        valid, unknown = np.isfinite(distance), np.full(distance.shape, np.nan)
        if int(valid.sum()) < FEWEST_PIXELS:
            return unknown, unknown, unknown
        z, basis = self._z[place], np.ascontiguousarray(self._basis[:, *place])
        measured = np.where(valid, distance, 1.0)
        inverse, metres = 1.0 / (measured * z), measured**2 * z

        def fitted(functions: np.ndarray) -> np.ndarray:
            """Return the factors of functions (K, h, w) whose sum is the nearest, in metres."""
            columns = functions.reshape(len(functions), -1)
            weighted = columns * np.where(use, metres**2, 0.0).ravel()
            return np.linalg.solve(weighted @ columns.T, weighted @ inverse.ravel())

        use, left = valid, unknown
        for _ in range(3):
            left = -(inverse - np.tensordot(fitted(basis), basis, 1)) * metres
            around = np.abs(left - np.median(left[use]))
            limit = _CLIP * sigma_from_mad(float(np.median(around[use])))
            kept = valid & (around <= limit) if limit > 0 else use
            if kept.sum() < FEWEST_PIXELS or np.array_equal(kept, use):
                break
            use = kept
        plane = fitted(basis[:3])  # 1/z = plane . (1, x, y)
        predicted = np.tensordot(plane, basis[:3], 1)
        normal = np.array([plane[1] / self._scale, plane[2] / self._scale, plane[0]])
        cosine = self._rays[place] @ (normal / np.linalg.norm(normal))
        left[~valid] = np.nan
        cosine[predicted <= 0] = predicted[predicted <= 0] = np.nan
        return left, 1.0 / (predicted * z), cosine


def _clipped(residual: np.ndarray, amplitude: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Clip residuals (R, H, W) at six robust standard deviations of pixels of their brightness.

    Returns:
        The clipped residuals, and the weights (H, W) that those standard deviations give, 1/m^2.
    """
    spread = _spread(residual, amplitude)
    # A group that repeats exactly has the rounding of float32 depth of 1 m.
    rounding = np.finfo(np.float32).eps
    weight = known_mean(1.0 / np.where(np.isinf(spread), rounding, spread) ** 2)
    return np.clip(residual, -_CLIP * spread, _CLIP * spread), np.nan_to_num(weight)


def _spread(residual: np.ndarray, amplitude: np.ndarray | None) -> np.ndarray:
    """Return the robust standard deviation of residuals (R, H, W) of the brightness of each.

    It is infinite where most are equal, and NaN where a residual is unknown.
    """
    known = np.flatnonzero(np.isfinite(residual))
    values = residual.ravel()[known]
    order = np.arange(len(known))
    if amplitude is not None:
        order = np.argsort(amplitude.ravel()[known], kind="stable")
    spread = np.full(len(known), np.inf)
    # Noise differs little within an eighth; an image of 32 x 25 pixels still has 100 in each.
    for part in np.array_split(order, min(8, len(order))) if len(order) else ():
        around = np.abs(values[part] - np.median(values[part]))
        spread[part] = sigma_from_mad(float(np.median(around))) or np.inf
    found = np.full(residual.size, np.nan)
    found[known] = spread
    return found.reshape(residual.shape)


def known_mean(images: np.ndarray) -> np.ndarray:
    """Return the mean of the known values of (R, ...); NaN where there is none."""
    known = np.isfinite(images)
    return quotient(np.where(known, images, 0.0).sum(0), known.sum(0))


def quotient(over: np.ndarray, under: np.ndarray) -> np.ndarray:
    """Return one array divided by another; NaN where that is not positive."""
    return np.divide(over, under, out=np.full(np.shape(under), np.nan), where=under > 0)


def log_of(values: np.ndarray) -> np.ndarray:
    """Return the logarithms of values; NaN where they are unknown or not positive."""
    return np.log(np.where(values > 0, values, np.nan))


def _repeated_variance(residual: np.ndarray) -> float:
    """Return the variance within the mean image of a pose, less that of its noise, m^2.

    Without repeats it is taken to be 0.
    """
    values = residual[:, np.isfinite(residual).all(0)]
    if len(values) < 2 or not values.size:
        return 0.0
    noise = values.var(0, ddof=1).mean() / len(values)
    return max(float(np.mean(values.mean(0) ** 2) - noise), 0.0)


def _frame_differences(residual: np.ndarray) -> np.ndarray:
    """Return half the squared differences of frames one and two apart, summed over tiles, m^2.

    Shape (2, T), of the pixels of (R, H, W) known in all frames; T is 0 with fewer than three.
    """
    known = np.asarray(np.isfinite(residual).all(axis=0))
    if len(residual) < 3:
        return np.zeros((2, 0))
    values, tile = residual[:, known], tiles_of(known)
    squares = [((values[lag:] - values[:-lag]) ** 2).mean(0) / 2 for lag in (1, 2)]
    return np.stack([np.bincount(tile, each) for each in squares])


class _BetweenPoses:
    """What images of different poses have in common, pixel by pixel: a pattern and not the noise.

    Args:
        shape: Height and width of the camera's images.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sums = np.zeros((4, *shape))

    def add(self, images: _PoseImages) -> None:
        """Add the images of one pose."""
        self._sums[:, *images.place] += self._parts(images)

    def without(self, images: _PoseImages) -> np.ndarray:
        """Return the residuals of a pose that was added, less what other poses show in each pixel.

        They are scaled to the variance of their noise: the mean of the others has some. A pixel
        that no other pose shows stays as it is.
        """
        total, _, weight, _ = self._sums[:, *images.place] - self._parts(images)
        frames, known = len(images.residual), weight > 0
        scale = frames * weight / np.where(known, frames * weight + images.weight, 1.0)
        varying = images.residual - total / np.where(known, weight, 1.0)
        return np.where(known, np.sqrt(scale) * varying, images.residual)

    @staticmethod
    def _parts(images: _PoseImages) -> np.ndarray:
        mean = known_mean(images.residual)
        weight = np.where(np.isfinite(mean) & ~images.edge, images.weight, 0.0)
        value = weight * np.nan_to_num(mean)
        return np.stack([value, value**2, weight, weight**2])

    def variance(self) -> float:
        """Return the mean product of two poses in one pixel: the variance of a fixed pattern."""
        total, squares, weight, weight_squares = self._sums
        pairs = float((weight**2 - weight_squares).sum())
        return max(float((total**2 - squares).sum()) / pairs, 0.0) if pairs > 0 else 0.0


def _shifted_pair(images: np.ndarray, axis: int, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return images (..., H, W) without their last, and without their first `lag` lines."""
    lines = np.moveaxis(images, axis - 2, 0)
    first, second = (np.moveaxis(each, 0, axis - 2) for each in (lines[:-lag], lines[lag:]))
    return first, second


def _alike(amplitude: np.ndarray, axis: int, lag: int) -> np.ndarray:
    """Return whether pixels `lag` apart are about equally bright, bool; of (..., H, W)."""
    first, second = _shifted_pair(amplitude, axis, lag)
    return np.abs(second - first) < SAME_BRIGHTNESS * (second + first) / 2


def _differences(
    images: np.ndarray, amplitude: np.ndarray | None, axis: int, lag: int
) -> np.ndarray:
    """Return differences of pixels `lag` apart; NaN if one is unknown, or differs in brightness."""
    first, second = _shifted_pair(images, axis, lag)
    return np.where(amplitude is None or _alike(amplitude, axis, lag), second - first, np.nan)


def second_differences(images: np.ndarray, amplitude: np.ndarray | None, axis: int) -> np.ndarray:
    """Return x - (left + right) / 2 over the spacing, scaled to the variance of one pixel.

    Args:
        images: Shape (..., H, W), metres; NaN where unknown.
        amplitude: Shape (..., H, W); None: unknown.
        axis: 1: along a row; 0: along a column.

    Returns:
        Shape (..., H, W), metres; NaN at the border, and where a pixel is unknown or its neighbours
        differ in brightness.
    """
    found = np.full(images.shape, np.nan)
    if images.shape[axis - 2] > 2 * SPACING:
        step = _differences(images, amplitude, axis, SPACING)
        before, after = _shifted_pair(step, axis, SPACING)
        inside = np.moveaxis(found, axis - 2, 0)[SPACING:-SPACING]
        inside[:] = np.moveaxis((before - after) / 2 / SECOND_DIFFERENCE**0.5, axis - 2, 0)
    return found


def _of_neighbours(images: _PoseImages) -> np.ndarray:
    """Sum over neighbours along each axis, at each lag, what `Observed` says.

    Returns:
        `temporal`: products of deviations from the mean of the repeats; `within`: half squares of
        differences in one image, where there is a second difference too; shape (2, 3, 2, 2).
    """
    sums = np.zeros((2, 3, len(AXES), len(LAGS)))
    deviation = images.deviation
    for (row, axis), (column, lag) in product(enumerate(AXES), enumerate(LAGS)):
        if len(deviation) > 1:
            first, later = _shifted_pair(deviation, axis, lag)
            both = np.isfinite(first) & np.isfinite(later)
            if images.amplitude is not None:
                both &= _alike(images.amplitude.mean(0), axis, lag)
            first, later = first[both], later[both]
            squares = (first @ first + later @ later) / 2
            sums[0, :, row, column] = first @ later, squares, len(first)
        found = _differences(images.varying, images.amplitude, axis, lag) / 2**0.5
        at, _ = _shifted_pair(images.second[axis], axis, lag)
        both = np.isfinite(found) & np.isfinite(at)
        sums[1, :, row, column] = (found[both] ** 2).sum(), (at[both] ** 2).sum(), both.sum()
    return sums


def _rows(images: _PoseImages, pose: int, target: int, shape: tuple[int, int]) -> np.recarray:
    """Return the rows of the sampled pixels of a pose that look at the target.

    The sample is the same in every image, so that two recordings can be compared pixel by pixel.
    `shape` is that of the image.
    """
    seen = np.zeros(shape, dtype=bool)
    seen[images.place] = images.on_target.any(0)
    step = max(seen.size / _MOST_OF_POSE, 1.0)
    pixel = (np.arange(min(seen.size, _MOST_OF_POSE)) * step).astype(np.int64)
    pixel = pixel[seen.ravel()[pixel]]
    rows, columns = images.place
    at = pixel // shape[1] - rows.start, pixel % shape[1] - columns.start
    chosen = (slice(None), *at)
    values, on_target = images.residual[chosen], images.on_target[chosen]
    known = np.isfinite(values)
    amplitude = raw = np.full(len(pixel), np.nan)
    if images.amplitude is not None:
        strength = images.amplitude[chosen]
        amplitude = known_mean(np.where(known, strength, np.nan))
        raw = known_mean(np.where(on_target, strength, np.nan))
    deviation = images.deviation[chosen]
    distance, cosine = images.distance[at], images.cosine[at]
    second = [known_mean(images.second[axis] ** 2)[at] for axis in AXES]
    fields = {
        "pose": np.full(len(pixel), pose),
        "pixel": pixel,
        "distance": distance,
        "cosine": cosine,
        "signal": cosine / distance**2,
        "target": np.full(len(pixel), target),
        "amplitude": amplitude,
        "raw_amplitude": raw,
        "of_repeats": quotient(np.nansum(deviation**2, 0), np.isfinite(deviation).sum(0) - 1),
        "of_neighbours": known_mean(np.stack(second)),
        "of_nearest": _of_nearest(images.varying, images.amplitude)[at],
        "frames": on_target.sum(0),
        "missing": images.missing[chosen].sum(0),
        "saturated": images.saturated[chosen].sum(0),
    }
    return np.rec.fromarrays(list(fields.values()), names=",".join(fields))  # pyright: ignore[reportArgumentType]


def _of_nearest(residual: np.ndarray, amplitude: np.ndarray | None) -> np.ndarray:
    """Return mean half squares of the differences to the nearest pixels, (H, W); NaN: none."""
    squares = []
    for axis in AXES:
        found = _differences(residual, amplitude, axis, 1) ** 2 / 2
        line = np.full_like(residual.take([0], axis - 2), np.nan)
        squares += [np.concatenate(pair, axis - 2) for pair in ((line, found), (found, line))]
    return known_mean(np.concatenate(squares))
