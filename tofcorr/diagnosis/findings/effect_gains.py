"""Gains of further effects beside a model, each tested by the units that suit it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.additions import FlippedGains, HeldOutSquares
from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.crossval import left_out_solutions
from tofcorr.diagnosis.sums.left_out import tile_blocks
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.student_gains import student_gains
from tofcorr.diagnosis.sums.study import Study, likely_residual_of
from tofcorr.pixels.two_at_once import all_at_once
from tofcorr.simulation.effects.derivative import by_frame


class Gain(NamedTuple):
    """What one effect gains beside a model.

    Attributes:
        closed: What it closes of every pose, shape (U,), m^2.
        gains: Its gain, then those by chance, shape (1 + B,).
        null_closed: What it closes by chance, over all poses, shape (B,), m^2; None: not drawn.
    """

    closed: Tensor
    gains: Tensor
    null_closed: Tensor | None = None


Gains = dict[str, Gain]


def effect_gains(
    study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool, maps: bool
) -> Gains:
    """Return what each effect that is not in the model closes, and its gains.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
        squares: Of the model.
        flips: Whether to draw the null distributions.
        maps: Whether to test effects with one value a cell of the image.
    """
    maps = maps and bool(study.candidates.maps)
    if flips:
        return _with_columns(study, chosen, squares, flips=True, maps=maps)
    # Rules ask for the same sizes several times.
    found = study.remembered(
        f"what each closes beside {', '.join(sorted(chosen))}",
        lambda: _with_columns(study, chosen, squares, flips=False, maps=False),
    )
    return found | _of_maps(study, chosen, squares, flips=False) if maps else found


def _with_columns(
    study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool, maps: bool
) -> Gains:
    """Return the gains of effects with columns, and of maps if wanted."""
    layout = study.system.blocks.layout
    others = [name for name in layout.effects if name not in chosen]
    few = [name for name in others if study.candidates.is_tested_by_tiles(name)]
    most = [name for name in others if name not in few]
    # Two halves that take about as long.
    by_size = sorted(most, key=layout.size)
    halves = by_size[::2], by_size[1::2]

    def of_few_and_maps() -> Gains:
        found = _by_tiles(study, chosen, few, flips=flips) if few else {}
        return found | _of_maps(study, chosen, squares, flips=flips) if maps else found

    first, second, rest, closed = all_at_once(
        [
            *(partial(_gains_by_poses, study, chosen, half, flips=flips) for half in halves),
            of_few_and_maps,
            partial(_closed_by_poses, study, chosen, squares, most, flips=flips),
        ],
        about=chosen,
    )
    gains = first | second
    by_poses = {name: Gain(closed[name][0], gains[name], closed[name][1]) for name in most}
    return by_poses | rest


def _gains_by_poses(
    study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool
) -> dict[str, Tensor]:
    """Return the gain of each further effect, then those by chance; poses are the units.

    Args:
        study: The recording.
        chosen: Effects of the model.
        names: The further effects.
        flips: Whether to draw the null distributions.
    """
    system, resampling = study.system, study.resampling
    null = resampling.null_scores(system) if flips else None
    return student_gains(system.blocks.likely, chosen, names, resampling.folds, null)


def _closed_by_poses(
    study: Study,
    chosen: Sequence[str],
    squares: HeldOutSquares,
    names: Sequence[str],
    *,
    flips: bool,
) -> dict[str, tuple[Tensor, Tensor | None]]:
    """Return what each further effect closes of every pose, and by chance, as in `Gain`.

    Args:
        study: The recording.
        chosen: Effects of the model.
        squares: Of the model.
        names: The further effects.
        flips: Whether to draw the null distributions; only those of additions to the base model
            say what is closed by chance.
    """
    system = study.system
    by_chance: dict[str, Tensor] = {}
    if flips and not chosen:
        null = study.resampling.null_scores(system)
        drawn = null.even_of_folds(system.moments, system.blocks.even_scale)
        by_chance = squares.closed_by_chance(names, drawn)
    return {name: (squares.closed(name), by_chance.get(name)) for name in names}


def _by_tiles(study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool) -> Gains:
    """Return what each further effect closes, and its gains, as in `Gains`; tiles are the units.

    Args:
        study: The recording.
        chosen: Effects of the model.
        names: The further effects.
        flips: Whether to draw the null distributions.
    """
    tiles = study.resampling.tiles
    assert tiles is not None
    blocks = tile_blocks(study, [*chosen, *names])
    squares = HeldOutSquares(blocks, chosen, tiles.folds)
    likely = blocks.likely
    gains = FlippedGains(likely, chosen, tiles.folds, tiles.signs).of if flips else _unknown_gain
    units = study.system.blocks.num_units
    return {name: Gain(tiles.per_pose(squares.closed(name), units), gains(name)) for name in names}


def _unknown_gain(_: str) -> Tensor:
    return torch.full((1,), torch.nan, dtype=torch.float64)


def _of_maps(study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool) -> Gains:
    """Return what each effect with one value a cell closes, and its gains, as in `Gains`.

    The residual is that of the likely fit: the bend that an even fit leaves in every image would
    pass for a map.
    """
    residual = likely_residual_of(study, chosen)
    left_out = left_out_residual(study, chosen, study.system.blocks.likely) if flips else None
    found: Gains = {}
    for name, effect in study.candidates.maps.items():
        gain = map_gain(study, effect, residual, left_out)
        closed = squares.squares - _squares_without(study, chosen, gain.values)
        found[name] = Gain(closed, torch.cat([gain.gain.sum()[None], gain.null]))
    return found


def _squares_without(study: Study, chosen: Sequence[str], values: Tensor) -> Tensor:
    """Return the even sum of squares of each held-out pose once a map is subtracted, (U,), m^2.

    The model is fitted again, as it is beside any other effect: without the map its errors bent it.
    """
    system, blocks, share = study.system, study.system.blocks, study.fit.share
    left = system.residual - values
    even = blocks.even_scale * share * left
    products = study.observations.products
    scores = [products(own, even[:, None])[..., 0] for own in system.columns.of(chosen)]
    sums = Sums(
        gram=blocks.even.of(chosen)[0],
        score=torch.cat(scores, dim=1),
        layout=blocks.layout.only(chosen),
    )
    square = torch.zeros_like(blocks.square).index_add(0, study.unit_of_pixel, share * left**2)
    changed = replace(blocks, even=sums, square=square)
    return HeldOutSquares(changed, chosen, study.resampling.folds).squares


def left_out_residual(study: Study, chosen: Sequence[str], sums: Sums) -> Tensor:
    """Return residuals with the variance of the errors, shape (M,), metres.

    Args:
        study: The recording.
        chosen: Effects of the model.
        sums: Even or likely sums of every pose, by which the model is fitted.
    """
    system, observations = study.system, study.observations
    parts = system.columns.of(chosen)
    theta = left_out_solutions(sums, chosen)[observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    left = system.residual
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, observations.frame)[:, 0]
    return left
