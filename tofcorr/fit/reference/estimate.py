"""Estimates what a fitted model leaves: by its form, by the robot's poses, and by noise."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.estimation.random_effects import (
    Classes,
    GroupSums,
    Variances,
    estimate,
    random_effects,
    unknowns_given,
)
from tofcorr.fit.reference.correlation import Correlation
from tofcorr.fit.reference.form_functions import BOWS, CLASSES, SHAPES, FormFunctions
from tofcorr.fit.reference.linear_image import LinearImage, Linearisation, wall_moves
from tofcorr.fit.reference.reference import Reference, pixel_weights, repeated
from tofcorr.fit.reference.scatter import scatter
from tofcorr.fit.reference.views import view_of
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import within
from tofcorr.pixels.masks import off_the_wall, with_exclusion
from tofcorr.pixels.sample import some_pixels

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
    dataset = with_exclusion(dataset, off_the_wall(rays))
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
        inside = batch.valid & within(domain, batch.radial_distance, batch.amplitude)
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
