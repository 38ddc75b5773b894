"""What a recording is not: pixels that are outliers, and gaps that no camera makes.

Which pixels the base fit leaves out or weighs down: how many, how far off, where.

Gap and effects describe the other pixels. A camera whose errors are rare and large, such as flying
pixels at edges, has most of its error in pixels that are left out. So have masks that a plane fit
made from the depth: of a strong pattern of the sensor they leave few pixels, and what is left of it
looks like noise.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.geometry.rays import mostly_wrapped, multiples_in_words, unambiguous_range
from tofcorr.plausibility.finding import LARGEST_GAP, Inspection, in_words


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Pixels that the fit does not fully use.

    Class attributes:
        worth_a_warning: A warning is given from this share of outliers on. Normal noise makes 1 in
            16 000 pixels one; 1 % of pixels that are off by 0.1 m hold an error of 10 mm RMS.
            Chosen.

    Attributes:
        deleted: Share of the pixels that get no weight.
        reduced: Share of the pixels that get less than full weight.
        size: Root mean square residual of the deleted pixels, metres; 0 if there are none.
        noise: Root mean square noise of all other pixels, metres.
        place: Where they lie: a clause that follows "They lie".
        wrapped_by: The unambiguous range, metres, if most deleted pixels are off by multiples of
            it; None: they are not, or it is unknown.
    """

    worth_a_warning: ClassVar[float] = 0.01

    deleted: float
    reduced: float
    size: float
    noise: float
    place: str
    wrapped_by: float | None = None

    @property
    def warning(self) -> str:
        """A sentence or three for people; empty if outliers are rare.

        Fewer are worth one too where they hold more of the squared error than the noise does.
        """
        rare = self.deleted + self.reduced < self.worth_a_warning
        if rare and self.deleted * self.size**2 <= self.noise**2:
            return ""
        said, reason = [], ""
        if self.wrapped_by is not None:
            multiples = multiples_in_words(self.wrapped_by)
            reason = f"(most by {multiples}: they show a target beyond it) "
        if self.deleted:
            off = f"off by {1e3 * self.size:.0f} mm RMS {reason}and are left out as outliers"
            said.append(f"{_percent(self.deleted)} of the pixels are {off}")
        if self.reduced:
            whose = "" if self.deleted else " of the pixels"
            said.append(f"{_percent(self.reduced)}{whose} count less, as outliers")
        return (
            f"{'; '.join(said)}. They lie {self.place}. "
            "Gap and effects describe the other pixels: mask these, or find out what they show."
        )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if round(100 * share, 1) else "fewer than 0.1 %"


def outliers_of(study: Study) -> Outliers:
    """Count the pixels that the base fit leaves out or weighs down, and find where they lie."""
    odd, deleted = study.fit.trust < 1, study.fit.trust == 0
    errors = study.fit.residual[deleted]
    frequency = study.observations.recording.modulation_frequency
    whole = unambiguous_range(frequency) if frequency else None
    return Outliers(
        deleted=float(deleted.double().mean()),
        reduced=float((odd & ~deleted).double().mean()),
        size=float(errors.square().mean().sqrt()) if len(errors) else 0.0,
        noise=study.fit.floor,
        place=place_of(study, odd),
        wrapped_by=whole if mostly_wrapped(errors.numpy(), frequency) else None,
    )


def place_of(study: Study, chosen: Tensor) -> str:
    """Return a clause that says where the chosen pixels (M,), bool, lie.

    Crowded groups are reported if together they hold half of them.
    """
    if not bool(chosen.any()):
        return "nowhere"
    found = []
    for words, there in _places(study, chosen):
        held = float(there[chosen].double().mean())
        if held >= 0.5:
            found.append((held - float(there.double().mean()), held, words))
    if not found:
        return "all over the images"
    _, held, words = max(found)
    return f"mostly {words} ({100 * held:.0f} % of them)"


def _places(
    study: Study, chosen: Tensor, *, edge_ratio: float = 1.5
) -> Iterator[tuple[str, Tensor]]:
    """Yield a clause and the pixels, (M,), for each kind of place that is crowded.

    Args:
        study: The recording.
        chosen: Which pixels, shape (M,), bool.
        edge_ratio: Brightest over darkest pixel of a 3 x 3 neighbourhood that holds an edge of the
            target. Chosen: neighbours of one reflectivity differ by a few per cent and by noise.
    """
    observations, camera = study.observations, study.observations.recording.camera
    row, column = observations.pixel // camera.width, observations.pixel % camera.width
    # Tiles along a side, groups of like distance, and the most frames that are listed. Chosen.
    groups = 8
    found = {"at the rim of the target's mask": _at_edges(observations, observations.on_target, 1)}
    if observations.amplitude_images is not None:
        at_edges = _at_edges(observations, observations.amplitude_images, edge_ratio)
        found["at edges between dark and bright"] = at_edges
    tile = row * groups // camera.height * groups + column * groups // camera.width
    members = chosen & _crowded(tile, chosen)
    if bool(members.any()):
        places = torch.stack([row, column], dim=1)[members]
        (top, left), (bottom, right) = places.amin(0).tolist(), places.amax(0).tolist()
        words = f"in rows {top} to {bottom} and columns {left} to {right}"
        found[words] = (row >= top) & (row <= bottom) & (column >= left) & (column <= right)
    for words, there in found.items():
        if bool(_crowded(there.long(), chosen)[there].any()):
            yield words, there
    there = _crowded(observations.frame, chosen)
    numbers = observations.frame[there].unique().tolist()
    if numbers:
        words = f"in frame{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:groups]))}"
        more = len(numbers) - groups
        yield words + f" and {more} more" * (more > 0), there
    values = {"at distances from {:.2f} to {:.2f} m": study.inputs.radial_distance}
    if observations.amplitude is not None:
        values["at amplitudes from {:.0f} to {:.0f}"] = observations.amplitude
    inner = torch.linspace(0, 1, groups + 1, dtype=torch.float64)[1:-1]
    for words, own in values.items():
        levels = torch.quantile(own[:: len(own) // 100_000 + 1], inner)
        there = _crowded(torch.bucketize(own, levels), chosen)
        if bool(there.any()):
            yield words.format(float(own[there].min()), float(own[there].max())), there


def _at_edges(observations: Observations, images: Tensor, ratio: float) -> Tensor:
    """Return which pixels (M,) lie where images (F, H, W) change by more than a ratio.

    The largest over the smallest value in 3 x 3 pixels counts; a mask has no edge outside it.
    """
    found = []
    for frame, (start, end) in enumerate(observations.frame_ends):
        image = images[frame][None].float()
        high, low = max_pool2d(image, 3, 1, 1)[0], -max_pool2d(-image, 3, 1, 1)[0]
        there = (high > ratio * low) & observations.on_target[frame]
        found.append(there.flatten()[observations.pixel[start:end]])
    return torch.cat(found)


def _crowded(group: Tensor, chosen: Tensor) -> Tensor:
    """Return which pixels lie in groups with many chosen ones, shape (M,).

    Three times as many as among all pixels, and ten more: above ten, chance does not triple a
    count.

    Args:
        group: Of each pixel, shape (M,), int64.
        chosen: Which pixels, shape (M,), bool.
    """
    expected = torch.bincount(group) * chosen.double().mean()
    return (torch.bincount(group, chosen.double()) > 3 * expected + 10)[group]


def mask_warning(observations: Observations, *, least_share: float = 0.02) -> str:
    """Return a sentence or two for people; empty without a mask, or if it leaves enough.

    A pixel that less than one other pose shows, on average, cannot show a pattern: what two poses
    agree in is a pattern; one pose has nothing to agree with.

    Args:
        observations: The pixels.
        least_share: A mask that leaves less than this share of the measured pixels is worth a
            warning. Chosen: a board that fills a seventh of the image in width and height.
    """
    if observations.recording.mask is None:
        return ""
    seen, measured = observations.usable, observations.distance_images > 0
    share = float(seen.sum() / measured.sum().clamp(min=1))
    units = [seen[observations.unit == unit].any(0) for unit in range(observations.num_units)]
    poses = torch.stack(units).sum(0)
    alone = float((poses * (poses - 1)).sum() / poses.sum().clamp(min=1)) < 1
    if not alone and share >= least_share:
        return ""
    typical = (
        ", and a typical one of these in one pose alone: a pattern of the sensor cannot be "
        "distinguished from noise"
    )
    return (
        f"The mask leaves {100 * share:.1f} % of the measured pixels{typical * alone}. "
        "A mask made from the depth, as by RANSAC, leaves out the pixels with large "
        "errors: widen its threshold."
    )


def refuse_impossible_gap(study: Study, inspection: Inspection) -> None:
    """Refuse to name causes of a gap that remains after recalibration and is too large for any.

    Args:
        study: The recording, with its base fit.
        inspection: What is odd about the recording.

    Raises:
        CalibrationDataError: The gap is above `LARGEST_GAP`, or not a number.
    """
    gap = missed_distance(study)
    if gap <= LARGEST_GAP:
        return
    odd = " ".join(f"- {one.sentence}" for one in inspection.findings)
    outlying = tuple(inspection.outlying)  # A training leaves them out by itself.
    remedy = f"Leave {in_words(outlying)} out of the recording, or mend them. " if outlying else ""
    size = f"by {1e3 * gap:.0f} mm" if gap < 1 else "by more than a metre"
    raise CalibrationDataError(
        f"{study.observations.recording.path}: even for a camera fitted to them distances and "
        f"planes disagree {size}, and no effect of a camera makes more than "
        f"{1e3 * LARGEST_GAP:.0f} mm: poses, planes, units or intrinsics are wrong. Odd about the "
        f"recording: {odd or 'nothing else.'} {remedy}"
        "(--force, in Python force=True, names causes all the same.)"
    )


def missed_distance(study: Study) -> float:
    """Return by how much distances and planes disagree, metres; NaN: not a number.

    That is the larger of two: the error of each pose beside all others, and the spread of the
    distances about those to the planes, with no error model but a constant. A fit without a pose
    that alone shows a range of distances misses it by any amount, so `left_out_solutions` give the
    errors. They alone would be too small: an error model of the distance turns poses that are off
    by a metre into a camera that reads the same distance everywhere, and misses by the spread of
    its readings.
    """
    ols = study.sums.ols
    errors = ols.squares_at((), ols.left_out_solutions(()))
    square = float(errors.sum() / study.sums.count.sum())
    observations = study.observations
    off = observations.measured - predicted_distance(observations, study.fit.tool_from_camera)
    spread = float(sigma_from_mad((off - off.median()).abs().median()))
    return float(np.maximum(math.sqrt(max(square - study.fit.floor**2, 0.0)), spread))


def headline_of_given(as_given: float | None) -> str | None:
    """Return what to say first of a simulator that is off by more than any camera's effects.

    Args:
        as_given: The gap of the simulator as given, metres; None: there is none.
    """
    if as_given is None or as_given <= LARGEST_GAP:
        return None
    return (
        f"Doubtful simulator: as given it is off by more than {1e3 * LARGEST_GAP:.0f} mm, which is "
        "geometry rather than light: check its poses, its hand-eye transform and its unit first."
    )
