r"""Which pose belongs to which image: pairing, stops, and the lag between the two clocks.

Where the tool moves, the depth image changes. For a lag L the movement of the tool between the
times of two images, :math:`m_k(L)`, is held against the change of the images, :math:`a_k`:

.. math:: \hat L = \arg\max_L \operatorname{corr}_k\left(a_k, m_k(L)\right)

No hand-eye transform and no plane is needed. Where images are taken at stops only, many lags
explain them alike: then no lag is assumed. Once walls are known, `refine_lag` improves the result
on images that were taken while the tool moved:

.. math:: \hat L = \arg\min_L \sum_k \rho\left(r_k(t_k - L)\right)

with :math:`r_k` the distance of a plane from the nearest wall and :math:`\rho` Cauchy's loss.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.pose_track import PoseTrack, nearest
from tofcorr.importing.run import Refused

_STILL = 5e-4, 1e-3
"""Within a stop the tool moves less than this, metres, and turns less than this, radians: a few
times the repeatability of an industrial arm (0.05 to 0.1 mm), and 1 mm at 1 m."""

_STEP = 0.005
"""Step of the search for a lag, seconds: half of the 10 ms that matter at 0.1 m/s (1 mm)."""

_FARTHEST, _FAR_STEP = 30.0, 0.1
"""Lags beyond a delay are looked for up to this many seconds, in steps of so many. Set by hand:
clocks farther apart share no stops."""


@dataclass(frozen=True, kw_only=True)
class Lag:
    """An estimated lag.

    Attributes:
        seconds: Image stamps minus pose stamps; positive: images are stamped late.
        standard_error: From leaving out a tenth of the data at a time, seconds; 0: it was given.
        correlation: Between the changes of images and poses, at that lag; NaN: it was given.
    """

    seconds: float
    standard_error: float = 0.0
    correlation: float = float("nan")


def pair(
    names: Sequence[str],
    times: np.ndarray | None,
    track: PoseTrack,
    *,
    tolerance: float,
    lag: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, Refused, str]:
    """Find the pose of every image.

    Where images and poses both carry times, poses are interpolated at the images' times; of poses
    that are listed for stops only, the nearest is taken. Else they are matched by name, and without
    names by order: then there must be as many of both.

    Args:
        names: What each image is called.
        times: Shape (I,), seconds on the images' clock; None without times.
        track: The poses.
        tolerance: Largest time between an image and the nearest pose, seconds.
        lag: How much later an image is stamped than the pose it was taken at, seconds: the pose at
            `time - lag` is taken.

    Returns:
        The numbers (N,) of the images that have a pose, increasing; world_from_tool (N, 4, 4),
        metres; the images without a pose, and why; and `time`, `name` or `order`.

    Raises:
        CalibrationDataError: No image has a pose, or the lists do not belong together.
    """
    if times is not None and track.timestamp is not None:
        return *_by_time(names, times - lag, track, tolerance), "time"
    if track.names is not None:
        return *_by_name(names, track, track.names), "name"
    if len(names) != len(track):
        counts = f"{len(track)} poses and {len(names)} images"
        raise CalibrationDataError(f"{track.source}: {counts}, without times or names.")
    return np.arange(len(names)), track.world_from_tool, {}, "order"


def _by_time(
    names: Sequence[str], times: np.ndarray, track: PoseTrack, tolerance: float
) -> tuple[np.ndarray, np.ndarray, Refused]:
    assert track.timestamp is not None
    first, start = times.min(), track.timestamp[0]
    if times.max() < start or first > track.timestamp[-1]:
        said = f"poses begin at {start:.3f} s, images at {first:.3f} s: they share no time"
        raise CalibrationDataError(f"{track.source}: {said}. State --time-offset-s.")
    near = nearest(track.timestamp, times)
    poses = track.world_from_tool[near] if track.lists_stops(tolerance) else track.at(times)
    inside = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    gap = np.abs(times - track.timestamp[near])
    used = inside & (gap <= tolerance)
    refused = {
        names[k]: f"the nearest pose is {gap[k]:.3f} s away, the tolerance is {tolerance:g} s"
        if inside[k]
        else f"taken {gap[k]:.3f} s before the first pose or after the last"
        for k in np.flatnonzero(~used).tolist()
    }
    if not used.any():
        first = next(iter(refused.values()))
        raise CalibrationDataError(f"{track.source}: no image of {len(names)} has a pose: {first}.")
    return np.flatnonzero(used), poses[used], refused


def _by_name(
    names: Sequence[str], track: PoseTrack, called: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, Refused]:
    stems = [PurePath(name).stem for name in called]
    place = {stem: k for k, stem in enumerate(stems)}
    if len(place) < len(stems):
        twice = next(stem for stem in place if stems.count(stem) > 1)
        raise CalibrationDataError(f"{track.source}: two poses are called '{twice}'.")
    poses = np.array([place.get(PurePath(name).stem, -1) for name in names])
    images = np.flatnonzero(poses >= 0)
    if not len(images):
        said = f"no pose is called as an image is: poses '{called[0]}', images '{names[0]}'"
        raise CalibrationDataError(f"{track.source}: {said}.")
    reason = f"no pose of that name in {track.source}"
    refused = {names[k]: reason for k in np.flatnonzero(poses < 0).tolist()}
    return images, track.world_from_tool[poses[images]], refused


def find_stops(track: PoseTrack, times: np.ndarray, margin: float) -> np.ndarray:
    """Tell the images of stops from those of movements.

    An image is still if the tool hardly moves from `margin` before it to `margin` after it. Still
    images that follow one another without a movement between them are one stop.

    Args:
        track: The poses, with time stamps.
        times: Of the images on the clock of the track, shape (N,), increasing, seconds.
        margin: Seconds; at least the exposure and the uncertainty of the lag.

    Returns:
        The stop that each image belongs to, shape (N,); -1 while moving.
    """
    assert track.timestamp is not None
    here, ends = track.at(times), track.timestamp[[0, -1]]
    before, after = (track.at(np.clip(times + shift, *ends)) for shift in (-margin, margin))
    still = _near(here, before) & _near(here, after)
    number, at_rest = np.full(len(times), -1), np.flatnonzero(still)
    follows = np.diff(at_rest, prepend=-2) == 1
    follows[1:] &= _near(here[at_rest[1:]], here[at_rest[:-1]])
    number[at_rest] = np.cumsum(~follows) - 1
    return number


def _near(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether pairs of poses (N, 4, 4) differ by less than a stop allows, shape (N,)."""
    distance = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1)
    turn = torch.from_numpy(np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3])
    return (distance < _STILL[0]) & (se3.rotation_angle(turn).numpy() < _STILL[1])


def estimate_lag(
    track: PoseTrack, times: np.ndarray, change: np.ndarray, largest: float = 1.0, fewest: int = 12
) -> Lag | None:
    """Estimate the lag between images and poses.

    Args:
        track: The poses, with time stamps.
        times: Of the images, shape (I,), increasing, seconds on their own clock.
        change: How much each image differs from the one before, metres, shape (I - 1,); NaN where
            unknown.
        largest: Lags beyond this many seconds are not looked for: they are other clocks.
        fewest: Pairs of images; with fewer than 12 a correlation of 0.7 comes by chance in one of
            a hundred lists.

    Returns:
        The lag; None if the images do not tell (too few, or no movement seen in them).
    """
    reach = round(largest / _STEP)
    lags = np.arange(-reach, reach + 1) * _STEP
    moved = _movements(track, times, lags)
    usable = np.isfinite(change) & np.isfinite(moved).all(axis=0)
    if usable.sum() < fewest:
        return None

    def best(kept: np.ndarray | slice = slice(None)) -> tuple[float, float]:
        return _best(lags, _correlations(moved[:, usable][:, kept], change[usable][kept]))

    seconds, correlation = best()
    # The images do not follow poses that explain less than a quarter of their changes.
    if correlation < 1 / 2:
        return None
    error = _jackknife_error(lambda kept: best(kept)[0], int(usable.sum()))
    return Lag(seconds=seconds, standard_error=error, correlation=correlation)


def far_lags(
    track: PoseTrack, times: np.ndarray, change: np.ndarray, most: int = 12, apart: float = 0.5
) -> list[float]:
    """Propose lags far beyond a delay, seconds, those that the images follow best first.

    Two clocks, or lists that do not belong together. A robot that stops at equal times makes many
    lags alike; walls decide among them. The root of movements and changes counts, so that a few
    large ones do not.

    Args:
        track: The poses, with time stamps.
        times: As in `estimate_lag`.
        change: As in `estimate_lag`.
        most: Lags that are proposed at most: each costs a search for walls.
        apart: Seconds between two of them: less than a stop and a move take.
    """
    lags = np.arange(-_FARTHEST, _FARTHEST + _FAR_STEP, _FAR_STEP)
    follows = _correlations(np.sqrt(_movements(track, times, lags)), np.sqrt(change))
    found: list[float] = []
    for k in np.argsort(-follows)[: int((follows > 0).sum())]:
        if all(abs(lags[k] - other) >= apart for other in (0.0, *found)):
            found.append(float(lags[k]))
    return found[:most]


def _movements(track: PoseTrack, times: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return how far the tool moves from each time (I,) to the next at lags (L,), (L, I - 1).

    In metres; a turn by one radian counts as 1 m: the distance to the wall, about.
    """
    steps = (np.diff(track.at(times - lag), axis=0) for lag in lags)
    return np.stack([
        np.linalg.norm(step[:, :3, 3], axis=1)
        + np.linalg.norm(step[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
        for step in steps
    ])  # fmt: skip


def _correlations(moved: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the correlations of rows (L, K) with a list (K,), where both are known, shape (L,).

    It is 0 where less than three quarters are known, so that a few at an end do not decide.
    """
    unknown = ~(np.isfinite(moved) & np.isfinite(seen))
    both = np.ma.array([moved, np.broadcast_to(seen, moved.shape)], mask=[unknown, unknown])
    first, second = both - both.mean(axis=2, keepdims=True)
    found = (first * second).sum(1) / np.sqrt((first**2).sum(1) * (second**2).sum(1))
    return np.where(4 * unknown.sum(axis=1) <= len(seen), found.filled(0.0), 0.0)


def _best(lags: np.ndarray, correlation: np.ndarray, as_good: float = 0.1) -> tuple[float, float]:
    """Return the lag of the highest correlation and that correlation.

    It is zero if that leaves at most the share `as_good` more of the changes unexplained than the
    best lag: on drives with one image a stop the correlation has no peak (set on simulated ones).
    """
    top = float(correlation.max())
    zero = len(lags) // 2
    if 1 - correlation[zero] <= (1 + as_good) * (1 - top):
        return 0.0, float(correlation[zero])
    # The maximum of the parabola through three points.
    k = int(np.clip(correlation.argmax(), 1, len(lags) - 2))
    left, middle, right = correlation[k - 1 : k + 2]
    bend = left - 2 * middle + right
    shift = 0.0 if bend >= 0 else 0.5 * (left - right) / bend
    return float(lags[k] + shift * _STEP), top


def refine_lag(losses: Callable[[float], np.ndarray], first: Lag) -> Lag:
    """Refine a lag on planes seen while the tool moved.

    Args:
        losses: Takes a lag, seconds, and returns how badly each plane lies on its wall, shape (M,).
        first: The first estimate. Its error in simulated stop-and-go motion, at 5 to 30 images a
            second, is below 0.03 s.
    """
    bounds = (first.seconds - 30 * _STEP, first.seconds + 30 * _STEP)

    def best(used: np.ndarray) -> float:
        found: Any = minimize_scalar(
            lambda lag: float(losses(lag)[used].mean()), bounds=bounds, method="bounded",
            options={"xatol": _STEP / 50},
        )  # fmt: skip
        return float(found.x)

    every = np.ones(len(losses(first.seconds)), dtype=bool)
    error = _jackknife_error(best, len(every))
    return replace(first, seconds=best(every), standard_error=error)


def _jackknife_error(estimate: Callable[[np.ndarray], float], count: int) -> float:
    """Return the standard error of an estimate from a mask of `count` data, leaving out tenths."""
    parts = 10
    part = np.arange(count) * parts // count
    left_out = np.array([estimate(part != k) for k in range(parts)])
    return float(np.sqrt((parts - 1) * left_out.var()))
