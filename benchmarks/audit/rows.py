"""The rows of the table: which world, which effect, and what is done to the recording."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.audit.faults import Fault, board_planes, far_pixels, without_amplitude
from benchmarks.audit.forms import (
    ABOVE_FLOOR,
    BRIGHT_ROOM,
    SAGGING_BRACKET,
    WIGGLE_OF_DARK,
    of_name,
)
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.form import Form
from benchmarks.renewed.generator.measure import noise_of
from benchmarks.renewed.generator.ranges import Range
from benchmarks.renewed.generator.recording import record
from benchmarks.renewed.generator.strength import scaled
from benchmarks.renewed.generator.world import draw_world
from benchmarks.renewed.generator.writing import write_recording
from benchmarks.withheld.generator.rigid import Array

PLAIN: dict[str, Any] = {  # what most rows share, as ranges of the renewed check
    "IMAGES": {(48, 36): 1.0},
    "FRAMES": {60: 1.0},
    "MOST_PIXELS": 2e6,
    "NEAR_M": Range(0.5, 0.5),
    "FARTHEST_TIMES": Range(4.0, 4.0),
    "FREQUENCIES_MHZ": {(20.0,): 1.0},
    "NOISE_MM": Range(3.0, 3.0),
    "OUTDOOR": 0.0,
    "TAILS": {np.inf: 1.0},
    "SPATIAL_FILTER": {"none": 1.0},
    "TEMPORAL_FILTER": {0.0: 1.0},
    "ROUNDING_MM": {0.0: 1.0},
    "ROBOT_MM": Range(0.3, 0.3),
    "ON_THE_MOVE": 0.0,
    "REPEATED": {0.1: 1.0},
    "SCENES": {"wall": 1.0},
    "TARGETS": {"both": 1.0},
    "MASKS": {"exact, two pixels less": 1.0},
    "EXPOSURES": {"random": 1.0},
    "LOGGED": 1.0,
}
USUAL_MM = Range(4.0, 10.0, log=True)
WIDE_IMAGE = {"IMAGES": {(224, 172): 1.0}, "FRAMES": {40: 1.0}}
TEXTBOOK = ("odd_harmonics", "driver_droop", "halves_and_pairs", "two_exponentials", "veil")
PAIRS = (
    ("odd_harmonics", "logarithm"),
    ("halves_and_pairs", "two_exponentials"),
    ("clear_layer", "driver_droop"),
)


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        about: The case, in words.
        forms: Effects of each draw in turn; empty where nothing is missing.
        size_mm: RMS of each effect over the pixels on the target.
        ranges: What differs from `PLAIN`.
        wanted: What the design must be like, beyond what the forms want.
        fault: What is done to the recording afterwards.
        says: What a warning must hold for the row to be right; empty: none is needed.
        draws: How many recordings, unless asked for otherwise.
    """

    about: str
    forms: tuple[tuple[Form, ...], ...] = ()
    size_mm: Range = USUAL_MM
    ranges: Mapping[str, Any] = field(default_factory=dict)
    wanted: Mapping[str, Any] = field(default_factory=dict)
    fault: Fault | None = None
    says: str = ""
    draws: int = 2


def _each(*names: str) -> tuple[tuple[Form, ...], ...]:
    return tuple((of_name(name),) for name in names)


ROWS: dict[str, Row] = {
    "height": Row(
        "multipath, weight falls with height",
        ((ABOVE_FLOOR,),),
        Range(6.0, 20.0, log=True),
        draws=5,
    ),
    "room": Row("rendered wall, floor, side wall", _each("rendered_corner"), draws=3),
    "bright_room": Row("rendered bright room", ((BRIGHT_ROOM,),)),
    "edges": Row(
        "board edges, true footprints",
        _each("aperture"),
        wanted={"mask": "all that is seen"},
        says="outliers",
        draws=3,
    ),
    "stray_wide": Row("stray light, 172x224", _each("spread", "veil", "ghost"), ranges=WIDE_IMAGE),
    "filtered": Row(
        "noise of a filter, nothing missing",
        ranges={"SPATIAL_FILTER": {"mean of 3x3": 0.5, "gauss of 1.2 pixels": 0.5}},
        draws=4,
    ),
    "robot": Row("robot 2 mm, nothing missing", ranges={"ROBOT_MM": Range(2.0, 2.0)}, draws=4),
    "board_poses": Row(
        "board poses 1 mm / 2 mrad, no robot, nothing missing",
        ranges={"ROBOT_MM": Range(0.0, 0.0)},
        fault=board_planes,
        draws=3,
    ),
    "far_pixels": Row("3 % of the pixels 0.7 m off", fault=far_pixels, says="outliers"),
    "no_amplitude": Row(
        "wiggling, no amplitude, varied exposure",
        _each("odd_harmonics"),
        fault=without_amplitude,
    ),
    "no_amplitude_white": Row(
        "the same before a white wall",
        _each("odd_harmonics"),
        ranges={"TARGETS": {"white": 1.0}},
        fault=without_amplitude,
    ),
    "wiggle_of_dark": Row("wiggling times amplitude", ((WIGGLE_OF_DARK,),), draws=3),
    "frames_30": Row("30 frames", _each(*TEXTBOOK), ranges={"FRAMES": {30: 1.0}}),
    "warm_up": Row(
        "200 frames of warm-up",
        _each("two_exponentials", "line_with_pauses"),
        ranges={"FRAMES": {200: 1.0}},
    ),
    "far": Row(
        "0.5 to 6 m",
        _each("odd_harmonics", "duty_cycle"),
        ranges={"FARTHEST_TIMES": Range(12.0, 12.0)},
    ),
    "two": Row("two effects", tuple(tuple(of_name(name) for name in pair) for pair in PAIRS)),
    "wide_nothing": Row("172x224, nothing missing", ranges=WIDE_IMAGE),
    "roll_sag": Row("a bracket that sags with the roll", ((SAGGING_BRACKET,),)),
}


@dataclass(frozen=True)
class Made:
    """What is true of a recording: effects, sizes, distances and noise without it, metres."""

    effects: tuple[str, ...]
    sizes_mm: Mapping[str, float]
    fields: Mapping[str, Array]
    expected: Array
    noise: Array


def write_draw(seed: int, name: str, number: int, folder: Path) -> Made:
    """Write one recording of a row; it depends on seed, row and number alone."""
    row = ROWS[name]
    rng = np.random.default_rng([seed, number, sum(map(ord, name))])
    forms = row.forms[number % len(row.forms)] if row.forms else ()
    wanted = {key: value for form in forms for key, value in form.wanted.items()}
    with patch.multiple(ranges, **{**PLAIN, **row.ranges}):
        world = draw_world(rng, {**wanted, **row.wanted})
        sizes = [row.size_mm.draw(rng) * 1e-3 for _ in forms]
        hooks = [
            scaled(world, form, form.draw(rng, world), size)
            for form, size in zip(forms, sizes, strict=True)
        ]
        recorded, truth = record(rng, world, hooks)
    write_recording(folder, recorded)
    if row.fault is not None:
        row.fault(folder, recorded, rng)
    return Made(
        effects=tuple(form.effect for form in forms),
        sizes_mm=truth.sizes_mm(recorded.mask & np.isfinite(recorded.depth)),
        fields=truth.fields,
        expected=truth.expected,
        noise=noise_of(world, hooks),
    )
