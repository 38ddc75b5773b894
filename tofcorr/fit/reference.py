"""What a fitted model leaves: by its form, by the robot's poses, and by noise; `reference.json`.

`tofcorr check` needs it of the calibration's own frames. Noise is measured within each image.
Errors that every image has alike, such as a fixed pattern of the pixels, count there as noise and
make no image depart from another. What is expected between images is therefore compared with what
is seen, in the images of the calibration itself. Errors of neighbouring views are alike, too: where
no calibrated view is near, nothing has shown them.
"""

import json
import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import BeforeValidator, Field, PlainSerializer
from torch import Tensor

from tofcorr.correction.state import CalibrationState, Float64
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import (
    Classes,
    Curvature,
    Estimate,
    GroupSums,
    estimate,
    random_effects,
    reduced,
    unknowns_given,
)
from tofcorr.estimation.moments import LEAST_RESIDUAL
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.robust import student_quantile
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.fit.linear_image import (
    BOWS,
    CLASSES,
    SHAPES,
    LinearPixels,
    block_squares,
    design_effect,
    form_classes,
    linearised,
    wall_moves,
)
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.options import Count, NonNegativeNumber, Number, Options, refused_in_words
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import off_the_wall, some_pixels
from tofcorr.pixels.sample import pixels_of_image

if TYPE_CHECKING:
    from tofcorr.fit.problem import Fit

# What is believed before any residual was seen, and weighs as much as one of them: form errors of
# 1 mm, poses off by 0.3 mm and 0.3 mrad, as of an industrial robot, and walls flat to 0.05 mm.
_FORM, _POSE, _BOW = 1e-3, 3e-4, 5e-5


def _tensor(values: object) -> object:
    return torch.tensor(values, dtype=torch.float64) if isinstance(values, list) else values


Positive = Annotated[Number, Field(gt=0)]
Numbers = Annotated[Float64, BeforeValidator(_tensor), PlainSerializer(Tensor.tolist)]


class Reference(Options):
    """How far the camera may be from what its calibration says.

    Attributes:
        mean: What is left in the residuals along the twist of the hand-eye (if it was estimated),
            the coefficients and the `form_functions`, shape (P,); metres, radians. The
            unknowns are those of `LinearPixels`.
        covariance: Of these, shape (P, P).
        random_variance: Of what differs from image to image, shape (3 + S,), square radians and
            metres: two turns and a shift of the wall, by the robot and all else, and the smooth
            errors of `linear_image.shapes`.
        bow_variance: Of a bow of the wall that all images share, square metres.
        persistence: Correlation of the shifts of one pose and the next; 0: poses are independent.
        poses: From how many poses of the robot this is known.
        noise: a, b, c of the variance of a measured distance; None: the same for all pixels.
        scatter: Mean square of the images' departures from each other, whatever their walls, over
            what noise and smooth errors let expect; see `scatter`. Older files lack it and what
            follows.
        covariance_within: The covariance where only the insides of images are looked at. What all
            images have alike, such as a fixed pattern, is then in both recordings, and what is left
            is as small as they depart from each other. None: as `covariance`.
        views: From where each pose saw its wall, shape (K, 7); see `view_of`. None: not known.
    """

    mean: Numbers
    covariance: Numbers
    random_variance: Numbers
    bow_variance: Positive
    persistence: Annotated[Number, Field(ge=0, lt=1)]
    poses: Count
    noise: tuple[NonNegativeNumber, NonNegativeNumber, NonNegativeNumber] | None
    scatter: Positive = 1.0
    covariance_within: Numbers | None = None
    views: Numbers | None = None

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


def unknown_reference(state: CalibrationState, *, wall_is_known: bool) -> Reference:
    """Return what a run without a reference knows: the covariance of its coefficients.

    Before a known wall that is left out: the hand-eye transform, whose covariance with the
    coefficients is unknown, makes up for most of their errors there.
    """
    twist = 6 if state.hand_eye_estimated else 0
    size = twist + len(state.coefficients) + len(form_classes(state.domain))
    covariance = torch.zeros(size, size, dtype=torch.float64)
    if state.covariance is not None and not wall_is_known:
        own = slice(twist, twist + len(state.coefficients))
        covariance[own, own] = state.covariance
    return Reference(
        mean=torch.zeros(size, dtype=torch.float64),
        covariance=covariance,
        random_variance=torch.tensor([_POSE**2] * 3 + [_BOW**2] * SHAPES).double(),
        bow_variance=_BOW**2,
        persistence=0.0,
        poses=0,
        noise=state.noise,
    )


class ImageSums:
    """Sums of products over the pixels of images, which are added group by group.

    Args:
        noise: a, b, c of the variance of a measured distance; None: the same for all pixels, which
            is only a scale, since the noise of each image is measured.
    """

    def __init__(self, noise: tuple[float, float, float] | None) -> None:
        self._noise = None if noise is None else DistanceNoise(*noise, source="neighbours")
        self._products: dict[int, Tensor] = {}
        self._count: Counter[int] = Counter()
        self._views: dict[int, Tensor] = {}
        self._squares = torch.zeros(())

    def add(
        self, group: int, image: LinearPixels, shared: Sequence[Tensor], residual: Tensor
    ) -> None:
        """Add an image to a group.

        Args:
            group: Which one, such as a pose.
            image: Its pixels, with amplitudes where there is a noise.
            shared: Columns of what all images share, after the offset, each (M, K).
            residual: Of the pixels, shape (M,), metres.
        """
        weight = torch.full_like(residual, _FORM**-2)
        if self._noise is not None:
            weight = 1 / self._noise.variance(image.pixels.amplitude).clamp(min=LEAST_RESIDUAL**2)
        own = [image.moves, image.shapes, residual[:, None]]
        columns = torch.cat([image.gain[:, None], *shared, *own], dim=1)
        products = columns.T @ (weight[:, None] * columns)
        self._products[group] = self._products.get(group, 0.0) + products
        self._count[group] += len(residual)
        self._squares = self._squares + block_squares(image, weight)
        # The wall's normal, the direction to its middle, and the logarithm of its distance.
        middle = image.points.mean(dim=0)
        distance = middle.norm()
        view = torch.cat([image.normal[0], middle / distance, distance.log()[None]])
        self._views.setdefault(group, view)

    def __len__(self) -> int:
        """Return how many groups there are."""
        return len(self._count)

    @property
    def groups(self) -> GroupSums:
        """The sums of each group."""
        count = torch.tensor(list(self._count.values())).double()
        return GroupSums(torch.stack(list(self._products.values())), count, 3 + SHAPES)

    @property
    def views(self) -> Tensor:
        """From where the first image of each group saw its wall, shape (G, 7)."""
        return torch.stack(list(self._views.values()))

    @property
    def design_effect(self) -> float:
        """Of pixels that are alike fewer count, by so much."""
        return design_effect(self._squares)


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
    usual = torch.quantile(apart.min(dim=1).values, 1 - 1 / 20)
    return float((torch.cdist(views, calibrated).min(dim=1).values > usual).double().mean())


def own_noise(sums: GroupSums) -> Tensor:
    """Return the variance of an observation of weight 1 within each image, shape (G,).

    Args:
        sums: Of each image; its first unknown is the offset.
    """
    # What offset, wall and shapes leave of the squares of each image's residuals.
    first = sums.products.shape[1] - sums.random - 1
    own = sums.products[:, [0, *range(first, sums.products.shape[1])]]
    own, right = own[:, :-1, [0, *range(first, sums.products.shape[1] - 1)]], own[:, :-1, -1]
    explained = torch.einsum("gi,gij,gj->g", right, Curvature(own).inverse, right)
    left = sums.products[:, -1, -1] - explained
    return left / (sums.size - sums.random - 1).clamp(min=1)


def scatter(sums: GroupSums, found: Estimate) -> float:
    """Return the mean square of the images' departures over what is expected; 1: as expected.

    Args:
        sums: Of each image; the first unknown is the offset, the others are those of `found`.
        found: What the images say together, without an offset.
    """
    precision = 1 / found.variances.random
    precision[:3] = 0.0  # Turns and shift of each image's own wall.
    each, right = reduced(sums, own_noise(sums), precision)
    gain, cross = each[:, 0, 0], each[:, 0, 1:]
    score = right[:, 0] - cross @ found.mean
    expected = gain - ((cross @ found.covariance) * cross).sum(dim=1)
    # With fewer pixels beyond its effects, an image's noise is hardly known.
    told = (gain > 0) & (sums.size - sums.random > 30)
    departure, free = score[told].square() / gain[told], (expected[told] / gain[told]).clamp(min=0)
    return float(departure.sum() / free.sum()) if float(free.sum()) > 0 else 1.0


# Kinds of what differs from pose to pose: turns, shift, bows, finer shapes.
_RANDOM = torch.tensor([0, 0, 1] + [2] * BOWS + [3] * (SHAPES - BOWS))


def estimate_reference(
    dataset: Dataset, frames: np.ndarray, fit: "Fit", noise: tuple[float, float, float] | None
) -> Reference | None:
    """Return how far the camera may be from what a fitted model says, frame by frame.

    Of more than 200 frames, evenly spread ones are looked at. With more, or with more pixels, what
    the form leaves out is known no better, because it is the same in all.

    Args:
        dataset: The recordings, without the pixels that the fit left out.
        frames: Global numbers of the frames, fitted or held out.
        fit: The fitted model; pixels outside of its ranges are not looked at.
        noise: a, b, c of the variance of a measured distance; None: all pixels weigh the same.

    Returns:
        The reference; None with fewer than three poses, and where the equations have no solution:
        a fit that took every point to the camera leaves no noise.
    """
    rays = dataset.ray_directions()
    dataset = dataset.without(partial(off_the_wall, rays=rays))
    noise = noise if dataset.has_amplitude else None
    model, domain, twist = fit.model, fit.domain, fit.solution.parameters.hand_eye_is_free
    hand_eye, poses = model.hand_eye().detach(), dataset.column("world_from_tool")
    groups, names = dataset.pose_groups(), dataset.targets
    frames = frames[:: max(-(-len(frames) // 200), 1)]
    # Where the planes may be wrong, each wall's place is unknown.
    walls = [] if fit.walls is None else sorted(set(names[frames].tolist()))
    sums = ImageSums(noise)
    for batch in dataset.batches(frames):
        inside = batch.valid & domain.holds(batch.radial_distance, batch.amplitude)
        for k, frame in enumerate(batch.indices.tolist()):
            used = some_pixels(inside[k].flatten().nonzero()[:, 0], 1200, frame)
            if not len(used):
                continue
            plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
            pixels, ray = pixels_of_image(batch, k, used), rays.flatten(0, 1)[used]
            image = linearised(model.error, pixels, ray, plane, twist=twist, domain=domain)
            wall = wall_moves(image.points, plane[0], poses[frame] @ hand_eye)
            shared = [wall * (name == names[frame]) for name in walls]
            shared = [image.unknowns, image.shapes[:, :BOWS], *shared]
            sums.add(int(groups[frame]), image, shared, image.residual)
    if len(sums) < 3:
        return None
    products, count, random = sums.groups
    effect = sums.design_effect
    of_poses = GroupSums(products / effect, count / effect, random)
    try:
        found = _solved(of_poses, form_classes(domain), noise, 3 * len(walls))
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
        return None
    return found.model_copy(update={"views": sums.views})


def _solved(
    with_offset: GroupSums, classes: Tensor, noise: tuple[float, float, float] | None, of_walls: int
) -> Reference:
    """Return the reference, without views, from the sums of each pose.

    Args:
        with_offset: Their first unknown is an offset, which is not estimated here.
        classes: The kind of each function of the form.
        noise: Of a pixel.
        of_walls: How many of the unknowns place walls.
    """
    sums = with_offset._replace(products=with_offset.products[:, 1:, 1:])
    kept = sums.unknowns - of_walls - BOWS
    of_unknown = torch.full((sums.unknowns,), -1)
    of_unknown[kept - len(classes) : kept] = classes
    of_unknown[kept : kept + BOWS] = CLASSES
    of = Classes(
        of_random=_RANDOM,
        of_unknown=of_unknown,
        believed_random=torch.full_like(_RANDOM.unique().double(), _POSE**2),
        believed_unknown=torch.tensor([_FORM**2] * CLASSES + [_BOW**2]).double(),
    )
    # On the twist and the coefficients: wider than the error of any camera that was calibrated.
    wide = torch.where(of_unknown < 0, PRIOR_SIGMA**-2, 0.0).double().diag()
    found = estimate(sums, wide, of._replace(largest_random=_without_unknowns(sums, of)))
    persistence = _persistence(random_effects(sums, found)[0][:, 2])
    departs, variances = scatter(with_offset, found), found.variances
    # Of poses that are alike fewer count, as if each were as much worse.
    random = variances.random * repeated(persistence, len(sums.size))
    known = unknowns_given(sums, wide, variances._replace(random=random))
    # Noise and smooth errors, not walls, that images have alike leave them as far apart as they are
    # seen to be.
    apart = torch.where(_RANDOM < 2, 1.0, departs).double()
    seen = variances._replace(noise=variances.noise * departs, random=random * apart)
    inside = unknowns_given(sums, wide, seen)
    return Reference(
        mean=known.mean[:kept],
        covariance=known.covariance[:kept, :kept],
        random_variance=variances.random,
        bow_variance=float(variances.unknowns[kept]),
        persistence=persistence,
        poses=len(sums.size),
        noise=noise,
        scatter=departs,
        covariance_within=inside.covariance[:kept, :kept],
    )


def _persistence(shift: Tensor) -> float:
    """Return the correlation of one pose's shift and the next one's; 0 where chance explains it.

    Of independent poses it is above in one recording of a hundred.
    """
    tiny = torch.finfo(shift.dtype).tiny
    found = float((shift[1:] * shift[:-1]).sum() / shift.square().sum().clamp(min=tiny))
    by_chance = student_quantile(1 - 1 / 100, math.inf) / math.sqrt(len(shift))
    return found if found > by_chance else 0.0


def _without_unknowns(sums: GroupSums, of: Classes) -> Tensor:
    """Return the variances of the effects if the fitted model were exact.

    They bound those beside unknowns: a model that is changed to fit the insides of images must not
    make up for it by poses that are wrong.
    """
    first = sums.unknowns
    own = GroupSums(sums.products[:, first:, first:], sums.size, sums.random)
    none = of._replace(of_unknown=of.of_unknown[:0])
    return estimate(own, torch.zeros(0, 0).to(sums.products), none).variances.random


REFERENCE_FILE = "reference.json"
"""Its name in a run folder."""

_ADVICE = "train again, or remove the file to check without it."
_FORMAT = {"format": "tofcorr-reference", "version": 2}


def save_reference(path: Path, reference: Reference, state: CalibrationState) -> None:
    """Write a reference as JSON, with the coefficients that it belongs to."""
    values = _FORMAT | {"coefficients": state.coefficients.tolist()} | reference.to_mapping()
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
    values: dict[str, Any] = {}
    coefficients = state.coefficients.tolist()
    try:
        values |= json.loads(path.read_text(encoding="utf-8"))
        digest = values.pop("sha256")
        wrong = {
            "it was changed after it was written": digest != _digest(values),
            "it is of another version": any(values.pop(k) != v for k, v in _FORMAT.items()),
            "it is of another calibration": values.pop("coefficients") != coefficients,
        }
    except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        wrong = {f"it cannot be read ({error})": True}
    for reason in (reason for reason, holds in wrong.items() if holds):
        raise CalibrationDataError(f"{path}: {reason}; {_ADVICE}")
    # What is sealed, and belongs to these coefficients, has the shapes that this program wrote.
    with refused_in_words(Reference, str(path), CalibrationDataError):
        return Reference.model_validate(values)


def _digest(values: dict[str, Any]) -> str:
    """Return the digest of all entries; numbers come back from JSON as they were written."""
    return sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
