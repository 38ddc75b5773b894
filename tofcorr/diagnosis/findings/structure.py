r"""How much structure a residual contains, whatever its shape, and the noise that is none.

The mean product of residuals of different pixels in one small tile estimates the variance that they
share. Noise is independent, or its known share is subtracted (`SharedNoise`). Tiles are squares,
pieces of rows and pieces of columns, so that patches and stripes of both directions are detected.

The noise of two poses is independent. So the product of their mean residuals in one cell, over all
pairs of poses, estimates the square of the structure there, however neighbouring pixels share their
noise: a rough target looks like filtered noise in any one image, but all images of it agree.

Slow waves over the image are structure that no filter of the noise makes. With x and y from 0 to 1
over the image, the residual of every pose has a score for each wave

.. math:: \cos(\pi i x) \cos(\pi j y) ,

beside the pose's own offset and tilts, in units of its standard error. Noise has the same energy in
all of them, whatever its level and however neighbours share it, as long as filters are shorter than
the waves. Structure has not. So the wave with the most energy is compared with the others, an F
test with the poses as units: it needs no floor. The residual is that of the generalised fit. Where
poses scatter, an ordinary fit bends the base model towards their offsets, which leaves waves in
every pose that shows a range of distances.

The noise that is no gap has a floor. Repeats or neighbouring pixels determine it to 5 per cent
only, which is as large as a small gap. Within these 5 per cent, or as much as the estimate of the
noise leaves open, the floor is what the final model leaves, less the variance that pixels, images
or poses share. It is never more than what is left inside images, without the waves that noise does
not make.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR, brightness_of
from tofcorr.diagnosis.sums.observations import TINY, small_tiles
from tofcorr.diagnosis.sums.shared_noise import shared_noise
from tofcorr.diagnosis.sums.study import Study


@dataclass(frozen=True, kw_only=True)
class Coherence:
    """Variances that pixels share, m^2.

    Attributes:
        within: Inside images, without each pose's offset and tilts; the largest over the shapes of
            tiles.
        between: Of the offsets and tilts of poses.
        fixed: Of what is the same in every image; `within` contains part of it too.
        form: Shape of the tiles with the largest value: `squares`, `rows` or `columns`.
        noise_share: Share of the variance of the noise that was subtracted from `within`.
    """

    within: float
    between: float
    fixed: float
    form: str
    noise_share: float = 0.0


def coherence(study: Study, residual: Tensor) -> Coherence:
    """Measure the structure of a residual, shape (M,), metres."""
    return coherence_inside(study, *without_pose(study, residual))


def coherence_inside(study: Study, inside: Tensor, between: float) -> Coherence:
    """Measure the structure of a residual, from what `without_pose` returns of it."""
    known, noise, found = study.fit.shared, study.fit.floor**2, []
    for form, cells in small_tiles(study.observations).items():
        found.append((_shared(study, inside, cells) - known.share[form] * noise, form))
    within, form = max(found)
    # What is the same in every image, from products between poses.
    pixel, share = study.observations.pixel.unique(return_inverse=True)[1], study.fit.share
    sums = _per_cell(study.unit_of_pixel, pixel, share * inside, share)
    products, pairs = ((own.sum(0) ** 2 - (own**2).sum(0)).sum() for own in sums)
    return Coherence(
        within=within,
        between=between,
        fixed=float(products / pairs.clamp(min=TINY)),
        form=form,
        noise_share=known.share[form],
    )


def _per_cell(group: Tensor, cells: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Return sums of values (M,) over the pixels of each group and cell, (groups, cells) each."""
    size, groups = int(cells.max()) + 1, int(group.max()) + 1
    zeros = torch.zeros(groups * size, dtype=torch.float64)
    place = group * size + cells
    return tuple(zeros.index_add(0, place, own).reshape(groups, size) for own in values)


def _shared(study: Study, residual: Tensor, cells: Tensor) -> float:
    """Return the mean product of different pixels of an image in a tile, m^2."""
    share, cells = study.fit.share, cells.unique(return_inverse=True)[1]
    values = share * residual, share
    sums = zip(values, _per_cell(study.observations.frame, cells, *values), strict=True)
    products, pairs = (total.square().sum() - own.square().sum() for own, total in sums)
    return float(products / pairs.clamp(min=TINY))


def without_pose(study: Study, residual: Tensor) -> tuple[Tensor, float]:
    """Subtract each pose's offset and tilts; return their mean square too, less that of noise.

    Args:
        study: The recording.
        residual: Shape (M,), metres.
    """
    inner, score = study.pose_equations(residual)
    covariance = torch.linalg.pinv(inner, hermitian=True)
    surface = study.pose_surface((covariance @ score[:, :, None])[:, :, 0])
    pose, share = study.pose, study.fit.share
    noise = ((pose[:, None, :] @ covariance[study.unit_of_pixel])[:, 0] * pose).sum(1)
    between = float((share * (surface**2 - noise)).sum() / share.sum())
    return residual - surface, between


class Structure(NamedTuple):
    """Variance that is no noise.

    Attributes:
        square: Its mean over the pixels, m^2; 0 where it is not significant.
        error: Standard error of `square`, m^2.
        p_value: Probability of as much by chance.
    """

    square: float = 0.0
    error: float = 0.0
    p_value: float = 1.0


def shared_by_poses(study: Study, residual: Tensor) -> Structure:
    """Return the largest of what poses share by pixel, place on the target, and brightness.

    It counts from three standard errors on, by convention, in cells that three poses show: they
    give three pairs.

    Args:
        study: The recording.
        residual: Without each pose's offset and tilts, shape (M,), metres.
    """
    units, share, found = study.sums.num_units, study.fit.share, Structure()
    order = brightness_of(study.observations).argsort().argsort()
    # Over a range of 1 to 30 in amplitude, 40 groups differ by 9 %, far less than what errors of
    # the amplitude need to change.
    for cells in (study.observations.pixel, _places(study), order * 40 // len(order)):
        own, count = _per_cell(study.unit_of_pixel, cells, share * residual, share)
        used = (count > 0).sum(0) >= 3
        if not bool(used.any()):
            continue
        # All poses at first, then all but one at a time.
        total, weight, squares, weights = (
            torch.cat([x.sum(0)[None], x.sum(0) - x])
            for x in (own[:, used], count[:, used], own[:, used] ** 2, count[:, used] ** 2)
        )
        pairs = (weight.square() - weights).clamp(min=torch.finfo(torch.float64).tiny)
        mean = ((total.square() - squares) / pairs * weight).sum(1) / weight.sum(1)
        spread = mean[1:] - mean[1:].mean()
        error = float(((units - 1) / units * spread.square().sum()).sqrt())
        square = float(mean[0])
        if square > max(3 * error, found.square):
            found = Structure(square, error)
    return found


def _places(study: Study) -> Tensor:
    """Return the place on the target that each pixel sees, in cells of a typical footprint."""
    inputs, observations = study.inputs, study.observations
    footprint = float(inputs.radial_distance.median()) / inputs.camera.matrix[0][0]
    _, target = np.unique(np.asarray(observations.recording.frames.target), return_inverse=True)
    cells = torch.from_numpy(target)[observations.frame]
    places = torch.floor(inputs.target_xy / footprint).long()
    for along in (places - places.amin(0)).unbind(1):
        cells = cells * (along.max() + 1) + along
    return torch.unique(cells, return_inverse=True)[1]


# Combinations of waves with a smaller share of their own square left, beside one another and the
# pose, are not seen by a pose. Chosen: a pose that shows half of the image sees all.
_LEAST_SEEN = 0.05


def unlike_waves(study: Study, chosen: Sequence[str]) -> Structure:
    """Test whether waves in what a model leaves, fitted by likelihood, have unlike energies.

    Args:
        study: The recording.
        chosen: Effects of the model.

    Returns:
        The p-value of the strongest, adjusted for their number; and the mean square that they add
        beyond what each of them has by noise.
    """
    squares, seen, weight = _energies(study, study.residual_of(chosen, gls=True))
    own = squares.sum(1) / seen.sum(1).clamp(min=_LEAST_SEEN)
    known = own > 0
    if seen.shape[1] < 2 or not bool(known.any()):
        return Structure()
    squares, seen, own, weight = squares[known], seen[known], own[known], weight[known]
    total, numbers = (squares / own[:, None]).sum(0), seen.sum(0)
    others = numbers.sum() - numbers
    energy = total / numbers.clamp(min=_LEAST_SEEN)
    rest = (total.sum() - total) / others.clamp(min=_LEAST_SEEN)
    tails = special.fdtrc(numbers.numpy(), others.numpy(), (energy / rest).numpy())
    beyond = (energy - energy.median()).clamp(min=0).sum()
    p_value = min(1.0, len(total) * float(tails.min()))
    return Structure(float(beyond * (own / weight).mean()), p_value=p_value)


def _energies(study: Study, left: Tensor, *, ridge: float = 1e-6) -> tuple[Tensor, Tensor, Tensor]:
    """Return squared scores of every pose and wave, what is seen of each, and summed weights.

    Args:
        study: The recording.
        left: The residual, shape (M,), metres.
        ridge: Added to the pose's equations, as a share of their diagonal, so that they can be
            solved for poses of few pixels. Chosen, far above rounding.

    Returns:
        (U, K), with mean `seen` under white noise of the level assumed; (U, K), 0 to 1; and (U,),
        1 / m^2.
    """
    step = slice(None, None, max(1, len(left) // 100_000))  # More would take longer than 50 ms.
    observations, weight = study.observations.at(step), study.weight[step]
    pose, count = study.pose[step], study.pose.shape[1]
    columns = torch.cat([pose, _waves(study, step), left[step, None]], dim=1)
    sums = observations.products(columns * weight[:, None], columns)
    size = sums.diagonal(dim1=1, dim2=2).clamp(min=TINY).sqrt()
    sums = sums / (size[:, :, None] * size[:, None, :])
    inner = sums[:, :count, :count] + ridge * torch.eye(count, dtype=torch.float64)
    across = sums[:, :count, count:]
    sums = sums[:, count:, count:] - across.mT @ torch.linalg.solve(inner, across)
    values, vectors = torch.linalg.eigh(sums[:, :-1, :-1])
    root = torch.where(values > _LEAST_SEEN, values.clamp(min=_LEAST_SEEN).rsqrt(), 0.0)
    scores = (vectors @ (root[:, :, None] * (vectors.mT @ sums[:, :-1, -1:])))[..., 0]
    seen = (vectors**2 * (root > 0)[:, None, :]).sum(2)
    whole = torch.bincount(study.unit_of_pixel[step], weight, len(scores))
    return (scores * size[:, -1:]) ** 2, seen, whole.clamp(min=TINY)


def _waves(study: Study, step: slice) -> Tensor:
    """Return all waves but a pose's own offset and tilts, (M, K), of some pixels.

    A wave is 16 pixels long at least: filters of 3 to 7 taps leave at least 80 % of the noise's
    energy at it (derived for a Gaussian of 1.2 pixels). Five half waves along one side, 20 waves in
    all, bound the time.
    """
    camera, inputs = study.inputs.camera, study.inputs
    sides = (camera.width, inputs.columns), (camera.height, inputs.rows)
    across, down = (max(1, min(5, pixels // 8)) for pixels, _ in sides)
    of_x, of_y = (
        [torch.cos(k * torch.pi / 2 * (place[step] + 1)) for k in range(6)] for _, place in sides
    )
    waves = [
        of_x[i] * of_y[j]
        for i, j in product(range(across + 1), range(down + 1))
        if i + j > 1 and (i / across) ** 2 + (j / down) ** 2 <= 1
    ]
    return torch.stack(waves, dim=1) if waves else of_x[0].new_zeros(len(of_x[0]), 0)


class NoiseFloor(NamedTuple):
    """The noise of a pixel.

    Attributes:
        size: Root mean square, metres.
        error: Standard error of its square, m^2.
        structure: What of its square may be structure, at most, m^2.
    """

    size: float
    error: float
    structure: float


def noise_floor(named: NamedEffects, *, sure: float = 0.01) -> NoiseFloor:
    """Return what the final model leaves and no pixels share, near the known floor.

    Without repeats a filter is looked for once more in what the final model leaves: the structure
    that it explains looked like a filter, or hid one.

    Args:
        named: The final model.
        sure: Waves with at most this p-value are no noise. The usual convention.
    """
    study, fit, found = named.study, named.study.fit, named.study.fit.shared
    left = study.residual_of(named.columns)
    if named.columns and not found.from_repeats:
        found = shared_noise(study.observations, left, fit.sigma, fit.trust)
        if study.observations.is_sample:  # Whole images said more of it.
            found = replace(found, level=fit.shared.level)
        study = replace(study, fit=replace(fit, shared=found))
    _, assumed, _ = fit.noise.limits(fit.shared.level)
    least, _, most = (bound / assumed for bound in fit.noise.limits(found.level))
    least, most = (1 - FLOOR_ERROR) * least * fit.floor, (1 + FLOOR_ERROR) * most * fit.floor
    own_of_images, between = without_pose(study, left)
    structure = coherence_inside(study, own_of_images, between)
    by_poses, alike = shared_by_poses(study, own_of_images), structure.noise_share
    inside = float((fit.share * left**2).sum() / fit.share.sum()) - max(between, 0.0)
    # Of the noise s^2, pixels share alike s^2; `within` lacks the same share of the known noise.
    shared = structure.within + alike * fit.floor**2
    square = (inside - shared) / (1 - alike)
    square = inside - max(shared - alike * max(square, 0.0), structure.fixed, 0.0)
    most_noise, hidden = inside - by_poses.square, 0.0
    own = float(np.clip(np.sqrt(max(min(square, most_noise), 0.0)), least, most))
    waves = unlike_waves(named.study, named.columns)
    if waves.p_value <= sure:
        # What poses share may be these waves: the larger of both is structure, not their sum. What
        # made the waves may have made others, which count as noise.
        most_noise, hidden = min(most_noise, inside - waves.square), waves.square
    # That of the known floor (two standard errors to either limit), though `own` scatters less:
    # structure that only single pixels show counts as noise.
    error = float(np.hypot((most**2 - least**2) / 4, by_poses.error))
    return NoiseFloor(min(own, max(most_noise, 0.0) ** 0.5), error, hidden)
