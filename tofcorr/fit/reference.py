"""What a fitted model leaves: by its form, by the robot's poses, and by noise; `reference.json`.

`tofcorr check` needs it of the calibration's own frames. Noise is measured within each image.
Errors that every image has alike, such as a fixed pattern of the pixels, count there as noise and
make no image depart from another. What is expected between images is therefore compared with what
is seen, in the images of the calibration itself. Errors of neighbouring views are alike, too: where
no calibrated view is near, nothing has shown them.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import Domain
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import (
    Classes,
    Curvature,
    Estimate,
    GroupSums,
    Variances,
    estimate,
    random_effects,
    reduced,
    unknowns_given,
)
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.fit.linear_image import (
    BOWS,
    CLASSES,
    SHAPES,
    Correlation,
    FormFunctions,
    LinearImage,
    Linearisation,
    wall_moves,
)
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import off_the_wall, some_pixels

# Noise of a pixel where nothing is known, metres: only a scale, since the noise of each image is
# measured; and the least noise, so that no pixel counts for all. Chosen.
_TYPICAL_NOISE, _LEAST_NOISE = 5e-3, 1e-4
# How much a robot's poses vary where nothing is known, metres and radians: only a scale as well.
_TYPICAL_POSE = 1e-3


@dataclass(frozen=True)
class Reference:
    """How far the camera may be from what its calibration says.

    Attributes:
        mean: What is left in the residuals along the twist of the hand-eye (if it was estimated),
            the coefficients and the functions of `FormFunctions`, shape (P,); metres, radians. The
            unknowns are those of `LinearImage.unknowns`.
        covariance: Of these, shape (P, P).
        random_variance: Of what differs from image to image, shape (3 + S,), square radians and
            metres: two turns and a shift of the wall, by the robot and all else, and the smooth
            errors of `form_functions.shapes`.
        bow_variance: Of a bow of the wall that all images share, square metres.
        persistence: Correlation of the shifts of one pose and the next; 0: poses are independent.
        poses: From how many poses of the robot this is known.
        noise: a, b, c of the variance of a measured distance; None: the same for all pixels.
        scatter: Mean square of the images' departures from each other, whatever their walls, over
            what noise and smooth errors let expect; see `scatter`.
        covariance_within: The covariance where only the insides of images are looked at. What all
            images have alike, such as a fixed pattern, is then in both recordings, and what is left
            is as small as they depart from each other. None: as `covariance`.
        views: From where each pose saw its wall, shape (K, 7); see `view_of`. None: not known.
    """

    mean: Tensor
    covariance: Tensor
    random_variance: Tensor
    bow_variance: float
    persistence: float
    poses: int
    noise: tuple[float, float, float] | None
    scatter: float = 1.0
    covariance_within: Tensor | None = None
    views: Tensor | None = None

    @property
    def independent_poses(self) -> float:
        """How many independent poses would tell as much as these."""
        return self.poses / repeated(self.persistence, self.poses)


def repeated(persistence: float, count: int) -> float:
    """Return by how much the variance of a mean exceeds that of independent values.

    Args:
        persistence: Correlation r of one value and the next; r^k that of values k apart.
        count: How many values.

    Example:
        >>> round(repeated(0.5, 2), 2)
        1.5
    """
    return 1 + 2 * sum((1 - k / count) * persistence**k for k in range(1, count))


def num_unknowns(state: CalibrationState) -> int:
    """Return how many unknowns a reference of a calibration has: twist, coefficients, form."""
    functions = len(FormFunctions(state.domain).classes())
    return (6 if state.hand_eye_estimated else 0) + len(state.coefficients) + functions


def unknown_reference(state: CalibrationState, *, wall_is_known: bool) -> Reference:
    """Return what a run without a reference knows: the covariance of its coefficients.

    Before a known wall that is left out: the hand-eye transform, whose covariance with the
    coefficients is unknown, makes up for most of their errors there.
    """
    twist, size = 6 if state.hand_eye_estimated else 0, num_unknowns(state)
    covariance = torch.zeros(size, size, dtype=torch.float64)
    if state.covariance is not None and not wall_is_known:
        own = slice(twist, twist + len(state.coefficients))
        covariance[own, own] = state.covariance
    return Reference(
        mean=torch.zeros(size, dtype=torch.float64),
        covariance=covariance,
        random_variance=torch.tensor([_TYPICAL_POSE**2] * 3 + [_LEAST_NOISE**2] * SHAPES).double(),
        bow_variance=_LEAST_NOISE**2,
        persistence=0.0,
        poses=0,
        noise=state.noise,
    )


def pixel_weights(noise: tuple[float, float, float] | None, image: LinearImage) -> Tensor:
    """Return one over the variance of each pixel's noise, shape (M,), 1 / m^2."""
    if noise is None or image.amplitude is None:
        return torch.full_like(image.residual, _TYPICAL_NOISE**-2)
    variance = DistanceNoise(*noise, source="neighbours").variance(image.amplitude)
    return 1 / variance.clamp(min=_LEAST_NOISE**2)


VIEW = 7
"""Numbers that describe a view: the wall's normal, direction to its middle, log of its distance."""


def view_of(image: LinearImage) -> Tensor:
    """Return what describes the view of an image, shape (7,)."""
    middle = image.points.mean(dim=0)
    distance = middle.norm()
    return torch.cat([image.normal, middle / distance, distance.log()[None]])


def share_unlike(views: Tensor, calibrated: Tensor) -> float:
    """Return the share of views further from any calibrated one than these are from each other.

    Args:
        views: Shape (N, 7).
        calibrated: Of one image of each pose, shape (K, 7); with few, no view counts as unlike.
    """
    # The distances of fewer calibrated views from each other say nothing.
    if len(calibrated) < 10:
        return 0.0
    apart = torch.cdist(calibrated, calibrated)
    apart.fill_diagonal_(math.inf)
    # Of views drawn at random from those of a calibration, one in twenty is said to be unlike them.
    usual = torch.quantile(apart.min(dim=1).values, 0.95)
    return float((torch.cdist(views, calibrated).min(dim=1).values > usual).double().mean())


# Turns and shift of each image's own wall: the first of its effects.
_OF_WALL = 3


def own_noise(sums: GroupSums) -> Tensor:
    """Return the variance of an observation of weight 1 within each image, shape (G,).

    Args:
        sums: Of each image; its first unknown is the offset.
    """
    left = torch.stack([_squares_left(products, sums.random) for products in sums.products])
    return left / (sums.size - sums.random - 1).clamp(min=1)


def scatter(sums: GroupSums, found: Estimate) -> float:
    """Return the mean square of the images' departures over what is expected; 1: as expected.

    Args:
        sums: Of each image; the first unknown is the offset, the others are those of `found`.
        found: What the images say together, without an offset.
    """
    precision = 1 / found.variances.random
    precision[:_OF_WALL] = 0.0
    each, right = reduced(sums, own_noise(sums), precision)
    gain, cross = each[:, 0, 0], each[:, 0, 1:]
    score = right[:, 0] - cross @ found.mean
    expected = gain - ((cross @ found.covariance) * cross).sum(dim=1)
    # With fewer pixels beyond its effects, an image's noise is hardly known.
    told = (gain > 0) & (sums.size - sums.random > 30)
    departure, free = score[told].square() / gain[told], (expected[told] / gain[told]).clamp(min=0)
    return float(departure.sum() / free.sum()) if float(free.sum()) > 0 else 1.0


def _squares_left(products: Tensor, random: int) -> Tensor:
    """Return the sum of squares that offset, wall and shapes leave of one image's residuals."""
    size = len(products)
    kept = [0, *range(size - random - 1, size - 1)]
    own, right = products[kept][:, kept], products[kept, -1]
    return products[-1, -1] - right @ Curvature(own).inverse @ right


# Most images and most pixels of each that are looked at: with more, what the form leaves out is
# known no better, because it is the same in all. Chosen: a tenth of a second on a small recording.
_MOST_IMAGES, _MOST_PIXELS = 200, 1200
# Standard deviation of the prior on the twist and the coefficients, metres and radians: wider than
# the error of any camera that was calibrated.
_WIDE = 0.1
# What is believed before any residual was seen, and weighs as much as one of them: form errors of
# 1 mm, poses off by 0.3 mm and 0.3 mrad, as of an industrial robot, and walls flat to 0.05 mm.
_FORM, _POSE, _BOW = 1e-3, 3e-4, 5e-5
# Kinds of what differs from pose to pose: turns, shift, bows, finer shapes.
_RANDOM = torch.tensor([0, 0, 1] + [2] * BOWS + [3] * (SHAPES - BOWS))
# First of the kinds that bend an image: those before move its wall.
_SMOOTH = 2
# Place of the shift among these. From `LinearImage.moves`: two turns, then the shift.
_SHIFT = 2
# Standard deviations of a correlation of independent poses, below which it counts as none: by
# chance it is above in one recording of a hundred.
_PERSISTS = 2.33
# Largest such correlation: one in nine poses then counts. Chosen.
_LONGEST = 0.8


def estimate_reference(
    dataset: Dataset,
    frames: np.ndarray,
    model: CalibrationModel,
    domain: Domain,
    noise: tuple[float, float, float] | None,
    *,
    twist: bool,
    walls_are_known: bool,
) -> Reference | None:
    """Return how far the camera may be from what a fitted model says, frame by frame.

    Args:
        dataset: The recordings, without the pixels that the fit left out.
        frames: Global numbers of the frames, fitted or held out.
        model: The fitted model.
        domain: The calibrated ranges; pixels outside are not looked at.
        noise: a, b, c of the variance of a measured distance; None: all pixels weigh the same.
        twist: Whether the hand-eye transform was estimated.
        walls_are_known: Whether the planes are right; otherwise each wall's place is unknown.

    Returns:
        The reference; None with fewer than three poses, and where the equations have no solution:
        a fit that took every point to the camera leaves no noise.
    """
    forms, rays = FormFunctions(domain), dataset.ray_directions()
    dataset = dataset.without(off_the_wall(rays))
    linear = Linearisation(model.error, forms, rays, twist)
    groups, names = dataset.pose_groups(), dataset.targets
    frames = frames[:: max(-(-len(frames) // _MOST_IMAGES), 1)]
    walls = [] if walls_are_known else sorted(set(names[frames].tolist()))
    products: dict[int, Tensor] = {}
    count: dict[int, int] = {}
    views: dict[int, Tensor] = {}
    correlation = Correlation()
    for frame, image, wall in _images(dataset, frames, linear, model, domain):
        weight = pixel_weights(noise, image)
        correlation.add(image, weight)
        places = [wall if name == names[frame] else torch.zeros_like(wall) for name in walls]
        shared = [image.unknowns, image.shapes[:, :BOWS], *places]
        own = [image.moves, image.shapes, image.residual[:, None]]
        columns = torch.cat([image.gain[:, None], *shared, *own], dim=1)
        group = int(groups[frame])
        found = columns.T @ (weight[:, None] * columns)
        products[group] = products[group] + found if group in products else found
        count[group] = count.get(group, 0) + len(weight)
        views.setdefault(group, view_of(image))
    if len(products) < 3:
        return None
    effect = correlation.design_effect()
    sums = GroupSums(
        torch.stack(list(products.values())) / effect,
        torch.tensor(list(count.values())).double() / effect,
        len(_RANDOM),
    )
    try:
        found = _solved(sums, forms, noise, 3 * len(walls))
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
        return None
    return replace(found, views=torch.stack(list(views.values())))


def _images(
    dataset: Dataset,
    frames: np.ndarray,
    linear: Linearisation,
    model: CalibrationModel,
    domain: Domain,
) -> Iterator[tuple[int, LinearImage, Tensor]]:
    """Yield each frame's number, its linear form, and its change by the place of the wall."""
    hand_eye = model.hand_eye().detach()
    poses = torch.cat([torch.from_numpy(one.frames.world_from_tool) for one in dataset.recordings])
    for batch in dataset.batches(frames):
        inside = batch.valid & domain.holds(batch.radial_distance, batch.amplitude)
        for k, frame in enumerate(batch.indices.tolist()):
            used = inside[k].flatten().nonzero()[:, 0]
            used = some_pixels(used, _MOST_PIXELS, frame)
            if len(used):
                plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
                image = linear(batch, k, used, plane)
                yield frame, image, wall_moves(image.points, plane[0], poses[frame] @ hand_eye)


def _solved(
    with_offset: GroupSums,
    forms: FormFunctions,
    noise: tuple[float, float, float] | None,
    of_walls: int,
) -> Reference:
    sums = with_offset._replace(products=with_offset.products[:, 1:, 1:])
    classes = forms.classes()
    kept = sums.unknowns - of_walls - BOWS
    of_unknown = torch.full((sums.unknowns,), -1)
    of_unknown[kept - len(classes) : kept] = classes
    of_unknown[kept : kept + BOWS] = len(CLASSES)
    kinds = int(_RANDOM.max()) + 1
    believed = torch.tensor([_FORM**2] * len(CLASSES) + [_BOW**2]).double()
    of = Classes(
        of_random=_RANDOM,
        of_unknown=of_unknown,
        believed_random=torch.full((kinds,), _POSE**2).double(),
        believed_unknown=believed,
        largest_random=torch.full((kinds,), torch.inf).double(),
    )
    wide = torch.where(of_unknown < 0, _WIDE**-2, 0.0).double().diag()
    start = Variances(
        noise=1.0,
        random=torch.full((sums.random,), _POSE**2).double(),
        unknowns=torch.where(of_unknown < 0, torch.inf, believed[of_unknown]),
    )
    of = of._replace(largest_random=_without_unknowns(sums, start, of))
    found = estimate(sums, wide, start, of)
    persistence = _persistence(random_effects(sums, found)[0][:, _SHIFT])
    departs = scatter(with_offset, found)
    # Of poses that are alike fewer count, as if each were as much worse.
    variances = found.variances
    fewer = variances._replace(
        random=variances.random * repeated(persistence, len(sums.size)),
    )
    known = unknowns_given(sums, wide, fewer)
    # Noise and smooth errors that images have alike leave them as far apart as they are seen to be.
    apart = torch.where(_RANDOM < _SMOOTH, 1.0, departs).double()
    seen = fewer._replace(noise=fewer.noise * departs, random=fewer.random * apart)
    within = unknowns_given(sums, wide, seen)
    return Reference(
        mean=known.mean[:kept],
        covariance=known.covariance[:kept, :kept],
        random_variance=variances.random,
        bow_variance=float(variances.unknowns[kept]),
        persistence=persistence,
        poses=len(sums.size),
        noise=noise,
        scatter=departs,
        covariance_within=within.covariance[:kept, :kept],
    )


def _persistence(shift: Tensor) -> float:
    """Return the correlation of one pose's shift and the next one's; 0 where chance explains it."""
    found = float((shift[1:] * shift[:-1]).sum() / shift.square().sum().clamp(min=1e-300))
    return min(found, _LONGEST) if found > _PERSISTS / math.sqrt(len(shift)) else 0.0


def _without_unknowns(sums: GroupSums, start: Variances, of: Classes) -> Tensor:
    """Return the variances of the effects, by class, if the fitted model were exact.

    They bound those beside unknowns: a model that is changed to fit the insides of images must not
    make up for it by poses that are wrong.
    """
    first = sums.unknowns
    own = GroupSums(sums.products[:, first:, first:], sums.size, sums.random)
    none = of._replace(of_unknown=of.of_unknown[:0])
    bare = start._replace(unknowns=start.unknowns[:0])
    found = estimate(own, torch.zeros(0, 0).to(sums.products), bare, none).variances.random
    return torch.stack([found[of.of_random == k].max() for k in range(len(of.believed_random))])


REFERENCE_FILE = "reference.json"
"""Its name in a run folder."""

_FORMAT, _VERSION = "tofcorr-reference", 2
# Largest file that is read, bytes: a hundred times that of the largest shipped model.
_LARGEST = 200_000_000


def save_reference(path: Path, reference: Reference, state: CalibrationState) -> None:
    """Write a reference as JSON, with the coefficients that it belongs to."""
    values = {
        "format": _FORMAT,
        "version": _VERSION,
        "coefficients": state.coefficients.tolist(),
        "mean": reference.mean.tolist(),
        "covariance": reference.covariance.tolist(),
        "random_variance": reference.random_variance.tolist(),
        "bow_variance": reference.bow_variance,
        "persistence": reference.persistence,
        "poses": reference.poses,
        "noise": None if reference.noise is None else list(reference.noise),
        "scatter": reference.scatter,
        "covariance_within": _listed(reference.covariance_within),
        "views": _listed(reference.views),
    }
    values |= {"sha256": _digest(values)}
    path.write_text(json.dumps(values, allow_nan=False) + "\n", encoding="utf-8")


def load_reference(path: Path, state: CalibrationState) -> Reference | None:
    """Read the reference of a calibration; None where the run has none.

    Args:
        path: The file.
        state: The calibration that it must belong to.

    Raises:
        CalibrationDataError: The file is damaged, or belongs to another calibration.
    """
    if not path.is_file():
        return None
    try:
        return _reference(json.loads(_text(path)), state)
    except (OSError, ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise CalibrationDataError(
            f"{path}: is damaged, or not of this run ({error}); train again, or remove the file "
            "to check without it."
        ) from None


def _text(path: Path) -> str:
    if path.stat().st_size > _LARGEST:
        raise ValueError("it is far too large")
    return path.read_text(encoding="utf-8")


def _reference(values: Any, state: CalibrationState) -> Reference:  # noqa: ANN401 - any JSON
    if not isinstance(values, dict) or values["format"] != _FORMAT:
        raise ValueError(f"its format is not {_FORMAT}")
    if values["version"] != _VERSION:
        raise ValueError(f"its version is {values['version']}, this package reads {_VERSION}")
    if values["sha256"] != _digest({k: one for k, one in values.items() if k != "sha256"}):
        raise ValueError("it was changed after it was written")
    size = num_unknowns(state)
    of_state = _numbers(values, "coefficients", len(state.coefficients))
    if not torch.equal(of_state, state.coefficients.cpu()):
        raise ValueError("its coefficients are those of another calibration")
    covariance = _covariance(values, "covariance", size)
    persistence = float(_numbers(values, "persistence"))
    if not 0 <= persistence < 1:
        raise ValueError("persistence: expected a number from 0 to below 1")
    poses, noise = values["poses"], values["noise"]
    if type(poses) is not int or not 0 < poses < 10**9:
        raise ValueError("poses: expected a positive whole number")
    if noise is not None:
        a, b, c = _numbers(values, "noise", 3).tolist()
        if min(a, b, c) < 0:
            raise ValueError("noise: expected no negative number")
        noise = (a, b, c)
    # Files of older versions have neither of these.
    views, within = values.get("views"), values.get("covariance_within")
    return Reference(
        mean=_numbers(values, "mean", size),
        covariance=covariance,
        random_variance=_positive(values, "random_variance", 3 + SHAPES),
        bow_variance=float(_positive(values, "bow_variance")),
        persistence=persistence,
        poses=poses,
        noise=noise,
        scatter=float(_positive({"scatter": 1.0} | values, "scatter")),
        covariance_within=None
        if within is None
        else _covariance(values, "covariance_within", size),
        views=None if views is None else _numbers(values, "views", len(views), VIEW),
    )


def _covariance(values: dict[str, Any], key: str, size: int) -> Tensor:
    found = _numbers(values, key, size, size)
    if not torch.allclose(found, found.T) or bool((found.diagonal() < 0).any()):
        raise ValueError(f"{key}: is not one")
    return found


def _listed(values: Tensor | None) -> list[list[float]] | None:
    return None if values is None else values.tolist()


def _digest(values: dict[str, Any]) -> str:
    """Return the digest of all entries; numbers come back from JSON as they were written."""
    return sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _positive(values: dict[str, Any], key: str, *shape: int) -> Tensor:
    found = _numbers(values, key, *shape)
    if not bool((found > 0).all()):
        raise ValueError(f"{key}: expected positive numbers")
    return found


def _numbers(values: dict[str, Any], key: str, *shape: int) -> Tensor:
    found = torch.tensor(values[key], dtype=torch.float64)
    if found.shape != shape:
        raise ValueError(f"{key}: has shape {tuple(found.shape)}, expected {shape}")
    if not bool(found.isfinite().all()):
        raise ValueError(f"{key}: holds a value that is not finite")
    return found
