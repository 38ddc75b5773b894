"""Estimates what a fitted model leaves: by its form, by the robot's poses, and by noise."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.estimation.random_effects import Classes, GroupSums, Variances, estimate
from tofcorr.fit.reference.form_functions import CLASSES, FormFunctions
from tofcorr.fit.reference.linear_image import LinearImage, Linearisation
from tofcorr.fit.reference.reference import Reference, pixel_weights
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import within
from tofcorr.pixels.image_pixels import some_pixels

# Most images and most pixels of each that are looked at: with more, what the form leaves out is
# known no better, because it is the same in all. Chosen: a tenth of a second on a small recording.
_MOST_IMAGES, _MOST_PIXELS = 200, 1200
# Standard deviation of the prior on the twist and the coefficients, metres and radians: wider than
# the error of any camera that was calibrated.
_WIDE = 0.1
# What is believed before any residual was seen, and weighs as much as one of them: form errors of
# 1 mm, poses off by 0.3 mm and 0.3 mrad, as of an industrial robot.
_FORM, _POSE = 1e-3, 3e-4


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
        The reference; None with fewer than three poses.
    """
    forms = FormFunctions(domain)
    linear = Linearisation(model.error, forms, dataset.ray_directions(), twist)
    groups, names = dataset.pose_groups(), dataset.targets
    frames = frames[:: max(-(-len(frames) // _MOST_IMAGES), 1)]
    walls = [] if walls_are_known else sorted(set(names[frames].tolist()))
    products: dict[int, Tensor] = {}
    count: dict[int, int] = {}
    num_random = 0
    for frame, image in _images(dataset, frames, linear, model, domain):
        weight = pixel_weights(noise, image)
        place = np.zeros(0, int) if walls_are_known else np.array(walls) == names[frame]
        columns = torch.cat([image.unknowns, *_own_wall(image, place)], dim=1)
        own = [columns, image.moves, image.shapes, image.residual[:, None]]
        columns = torch.cat(own, dim=1)
        group = int(groups[frame])
        found = columns.T @ (weight[:, None] * columns)
        products[group] = products[group] + found if group in products else found
        num_random = image.moves.shape[1] + image.shapes.shape[1]
        count[group] = count.get(group, 0) + len(weight)
    if len(products) < 3:
        return None
    sums = GroupSums(
        torch.stack(list(products.values())),
        torch.tensor(list(count.values())).double(),
        num_random,
    )
    return _solved(sums, forms, noise, 3 * len(walls))


def _own_wall(image: LinearImage, place: np.ndarray) -> list[Tensor]:
    """Return the columns of each wall's place: zeros but for the wall that the image shows."""
    return [image.moves if own else torch.zeros_like(image.moves) for own in place]


def _images(
    dataset: Dataset,
    frames: np.ndarray,
    linear: Linearisation,
    model: CalibrationModel,
    domain: Domain,
) -> Iterator[tuple[int, LinearImage]]:
    hand_eye = model.hand_eye().detach()
    for batch in dataset.batches(frames):
        inside = batch.valid & within(domain, batch.radial_distance, batch.amplitude)
        for k, frame in enumerate(batch.indices.tolist()):
            used = inside[k].flatten().nonzero()[:, 0]
            used = some_pixels(used, _MOST_PIXELS, frame)
            if len(used):
                plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
                yield frame, linear(batch, k, used, plane)


def _solved(
    sums: GroupSums, forms: FormFunctions, noise: tuple[float, float, float] | None, of_walls: int
) -> Reference:
    classes = forms.classes()
    fixed = sums.unknowns - len(classes) - of_walls
    of_unknown = torch.cat([torch.full((fixed,), -1), classes, torch.full((of_walls,), -1)])
    of_random = torch.tensor([0, 0, 1] + [2] * (sums.random - 3))
    of = Classes(
        of_random=of_random,
        of_unknown=of_unknown,
        believed_random=torch.full((3,), _POSE**2).double(),
        believed_unknown=torch.full((len(CLASSES),), _FORM**2).double(),
        largest_random=torch.full((3,), torch.inf).double(),
    )
    wide = torch.where(of_unknown < 0, _WIDE**-2, 0.0).double().diag()
    start = Variances(
        noise=1.0,
        random=torch.full((sums.random,), _POSE**2).double(),
        unknowns=torch.where(of_unknown < 0, torch.inf, _FORM**2).double(),
    )
    of = of._replace(largest_random=_without_unknowns(sums, start, of))
    found = estimate(sums, wide, start, of)
    kept = sums.unknowns - of_walls
    return Reference(
        mean=found.mean[:kept],
        covariance=found.covariance[:kept, :kept],
        pose_variance=found.variances.random[:3],
        shape_variance=float(found.variances.random[-1]),
        poses=len(sums.size),
        noise=noise,
    )


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
