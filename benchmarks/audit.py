"""Every case of an audit's table, made from a seed: what is true, and what the diagnosis says.

    python -m benchmarks.audit --seed S --out FILE.jsonl
    python -m benchmarks.audit --seed S --rows height:5,robot --out FILE.jsonl

Recordings come from the renewed generator (`benchmarks/renewed`), with its light, its sensor and
the base errors of its cameras; what a row needs beyond that is added here. A line is printed for
each, and kept in FILE; a run that was interrupted goes on where it stopped. Rooms need the
renderer (`benchmarks/README.md`).
"""

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.cases import Case, make_case
from benchmarks.renewed.forms import FORM
from benchmarks.renewed.forms.light import rendered
from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, inverse, small_motions
from benchmarks.renewed.ranges import Range
from benchmarks.renewed.recording import Recorded, depth_over_range, read, write_recording
from benchmarks.renewed.signal_chain import Change, Form, View, form
from benchmarks.renewed.world import World
from benchmarks.sealed.command import OUT, SEED, counts_by_name, kept_rows
from benchmarks.sealed.oracle import ask, counted
from benchmarks.sealed.scores import table

# Forms that the renewed check lacks.

CAMERA_WEIGHT = np.array([0.0, 0.0, -1.0])  # direction in the world


@form("multipath", "light", 0.1)
def above_floor(rng: np.random.Generator, world: World) -> Change:
    """Light by way of a floor, mirrored there; its weight falls with the height above the floor."""
    middle = float(np.sqrt(world.design.near * world.design.far))
    floor, fall = -middle * rng.uniform(0.3, 0.8), middle * rng.uniform(0.15, 0.5)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        mirrored = view.origin * [1.0, -1.0, 1.0] + [0.0, 2 * floor, 0.0]
        x, y, z = (mirrored[:, i, None, None] for i in range(3))
        longer = (np.sqrt((view.x - x) ** 2 + (view.y - y) ** 2 + z**2) - view.distance) / 2
        turn = np.exp(4j * np.pi * view.frequency / SPEED_OF_LIGHT * longer)
        weight = np.exp(-np.maximum(view.y - floor, 0.0) / fall)
        return phasor * (1 + strength * weight * turn)

    return change


@form("multipath", "light", scaled=False, scene="closed", moving=False)
def bright_room(rng: np.random.Generator, world: World) -> Change:
    """All bounces in a closed room whose walls are as bright as the target."""
    return rendered(world, replace(world.surface.room, albedo=rng.uniform(0.6, 0.85)))


@form("wiggling", "path", 0.01)
def wiggle_of_dark(rng: np.random.Generator, world: World) -> Change:
    """Wiggling that fades as pixels get brighter: distance times amplitude."""
    start, fade = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.5)
    turn = 16 * np.pi * world.sensor.frequencies[-1] / SPEED_OF_LIGHT

    def change(strength: float, view: View, path: Array) -> Array:
        dark = np.exp(-view.amplitude / view.bright / fade)
        return path + strength * dark * np.sin(turn * view.distance + start)

    return change


@form("robot_kinematics", "poses", 0.01)
def sagging_bracket(rng: np.random.Generator, world: World) -> Change:
    """The camera's bracket bends under its weight: its sag turns with the roll of the tool."""
    stiff = rng.uniform(0.5, 1.5, 2)

    def change(strength: float, view: View, world_from_tool: Array) -> Array:
        down = np.einsum("nji,j->ni", world_from_tool[:, :3, :3], CAMERA_WEIGHT)
        zero = np.zeros(len(down))
        bend = np.stack([-stiff[0] * down[:, 1], stiff[1] * down[:, 0], zero], -1)
        return world_from_tool @ small_motions(0.1 * strength * down, strength * bend)

    return change


# What is done to a recording after the camera; each takes its folder and changes its files.

Fault = Callable[[Path, Recorded, np.random.Generator], None]
BOARD = (1e-3, 2e-3)  # metres and radians, each axis: errors of a board's pose
OFF_SHARE, OFF_BY = 0.03, 0.7  # of the pixels; metres
NO_ROBOT = {"tx": 0, "ty": 0, "tz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}


def without_amplitude(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """The camera gives depth alone."""
    (folder / "amplitude.npy").unlink()


def far_pixels(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """Single pixels are far off, and the mask has them."""
    depth = np.load(folder / "depth.npy")
    off = rng.uniform(size=depth.shape) < OFF_SHARE
    depth += off * OFF_BY * depth_over_range(recorded.world)
    np.save(folder / "depth.npy", depth.astype(np.float32))


def board_planes(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """No robot: each pose's plane comes from the picture of a board, with its errors."""
    world = recorded.world
    draws = (size * rng.standard_normal((world.way.poses, 3)) for size in BOARD)
    true = inverse(world.world_from_tool() @ world.tool_from_camera) @ world.world_from_target
    board = small_motions(*draws)[world.way.pose_id] @ true
    normal = board[:, :3, 2]
    offset = -(normal * board[:, :3, 3]).sum(-1)
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, n, d in zip(rows, normal, offset, strict=True):
        row.update(NO_ROBOT | dict(zip(("nx", "ny", "nz", "d"), (*n, d), strict=True)))
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    about = folder / "recording.yaml"
    lines = [line for line in about.read_text().splitlines() if "tool_from_camera" not in line]
    lines.append(f"tool_from_camera: {json.dumps(np.eye(4).tolist())}")
    about.write_text("\n".join(lines) + "\n")


USUAL_MM = Range(4.0, 10.0, log=True)


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        about: The case, in words.
        forms: Effects of each draw in turn; empty where nothing is missing.
        size_mm: RMS of each effect over the pixels on the target.
        ranges: What differs from the plain laboratory.
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
    return tuple((FORM[name],) for name in names)


WIDE_IMAGE = {"images": {(224, 172): 1.0}, "frames": {40: 1.0}}
TEXTBOOK = _each("odd_harmonics", "driver_droop", "halves_and_pairs", "two_exponentials", "veil")
PAIRS = tuple(
    (FORM[one], FORM[other])
    for one, other in (
        ("odd_harmonics", "logarithm"),
        ("halves_and_pairs", "two_exponentials"),
        ("clear_layer", "driver_droop"),
    )
)
FILTERS = {"spatial_filter": {"mean of 3x3": 0.5, "gauss of 1.2 pixels": 0.5}}
WIGGLING = _each("odd_harmonics")
ROWS: dict[str, Row] = {
    "height": Row(
        "multipath, weight falls with height",
        ((above_floor,),),
        Range(6.0, 20.0, log=True),
        draws=5,
    ),
    "room": Row("rendered wall, floor, side wall", _each("rendered_corner"), draws=3),
    "bright_room": Row("rendered bright room", ((bright_room,),)),
    "edges": Row(
        "board edges, true footprints",
        _each("aperture"),
        wanted={"mask": "all that is seen"},
        says="outliers",
        draws=3,
    ),
    "stray_wide": Row("stray light, 172x224", _each("spread", "veil", "ghost"), ranges=WIDE_IMAGE),
    "filtered": Row("noise of a filter, nothing missing", ranges=FILTERS, draws=4),
    "robot": Row("robot 2 mm, nothing missing", ranges={"robot_mm": Range(2.0, 2.0)}, draws=4),
    "board_poses": Row(
        "board poses 1 mm / 2 mrad, no robot, nothing missing",
        ranges={"robot_mm": Range(0.0, 0.0)},
        fault=board_planes,
        draws=3,
    ),
    "far_pixels": Row("3 % of the pixels 0.7 m off", fault=far_pixels, says="outliers"),
    "no_amplitude": Row(
        "wiggling, no amplitude, varied exposure", WIGGLING, fault=without_amplitude
    ),
    "no_amplitude_white": Row(
        "the same before a white wall",
        WIGGLING,
        ranges={"targets": {"white": 1.0}},
        fault=without_amplitude,
    ),
    "wiggle_of_dark": Row("wiggling times amplitude", ((wiggle_of_dark,),), draws=3),
    "frames_30": Row("30 frames", TEXTBOOK, ranges={"frames": {30: 1.0}}),
    "warm_up": Row(
        "200 frames of warm-up",
        _each("two_exponentials", "line_with_pauses"),
        ranges={"frames": {200: 1.0}},
    ),
    "far": Row(
        "0.5 to 6 m",
        _each("odd_harmonics", "duty_cycle"),
        ranges={"farthest_times": Range(12.0, 12.0)},
    ),
    "two": Row("two effects", PAIRS),
    "wide_nothing": Row("172x224, nothing missing", ranges=WIDE_IMAGE),
    "roll_sag": Row("a bracket that sags with the roll", ((sagging_bracket,),)),
}


def write_draw(seed: int, name: str, number: int, folder: Path) -> Case:
    """Write one recording of a row; it depends on seed, row and number alone."""
    row = ROWS[name]
    rng = np.random.default_rng([seed, number, sum(map(ord, name))])
    forms = row.forms[number % len(row.forms)] if row.forms else ()
    with ranges.drawn_from(**{**ranges.PLAIN, **row.ranges}):
        case = make_case(rng, forms, row.size_mm, row.wanted)
    write_recording(folder, case.recorded)
    if row.fault is not None:
        row.fault(folder, case.recorded, rng)
    return case


RIGHT, SET, WARNING, WRONG = ANSWERS = ("right", "set holds it", "warning says why", "WRONG")


def judge(name: str, case: Case, folder: Path) -> dict[str, Any]:
    """Return what is true of a recording, what the diagnosis says, and the judgement."""
    from tofcorr.diagnosis.diagnose import diagnose
    from tofcorr.errors import TofcorrError

    data = read(folder)
    effects, sigma = [hook.form.effect for hook in case.hooks], case.noise[data.valid]
    left = 0.0  # the true gap that recalibration leaves, as pixels count in a report
    if effects:
        left = ask(data, case.truth.fields, case.truth.expected, counted(case.noise)).before_mm
    noise = 1e3 * float(np.sqrt(np.average(sigma**2, weights=counted(sigma))))
    true = {"effects": effects, "sizes_mm": case.sizes_mm, "left_mm": left, "noise_mm": noise}
    try:
        result = diagnose(folder, config={"page": False, "simulate_anew": False})
    except TofcorrError as error:
        return {"true": true, "refused": str(error), "judged": WARNING}
    gap = result.gap
    said = {
        "before_mm": [1e3 * x for x in (gap.before, *gap.before.interval)],
        "after_mm": [1e3 * x for x in (gap.after, *gap.after.interval)],
        "floor_mm": 1e3 * gap.floor,
        "sets": [list(members) for members in result.cause_sets],
        "likeliest": list(result.likeliest),
        "unknown": result.unknown,
        "unknown_p": result.remainder.p_value,
        "verdict": result.verdict,
        "remarks": list(result.remarks),
        "warnings": list(result.warnings),
        "missing": sorted(result.missing),
    }
    return {"true": true, **said, "judged": judged(effects, said, ROWS[name].says)}


def judged(truth: Sequence[str], said: Mapping[str, Any], needed: str) -> str:
    """The judgement.

    A set without a true effect is wrong, whatever else is said; so is silence about an effect, and
    a missing warning where one is needed. "Unknown" is a warning where an effect is missing.
    """
    sets = [set(members) for members in said["sets"]]
    warned = not needed or any(needed in text for text in said["warnings"])
    if not warned or any(not members & set(truth) for members in sets):
        return WRONG
    if not truth:
        return WRONG if sets or said["unknown"] else WARNING if needed else RIGHT
    if set(truth) <= set().union(*sets):
        return RIGHT if all(len(members) == 1 for members in sets) else SET
    return WARNING if said["unknown"] else WRONG


def line(draw: Mapping[str, Any]) -> str:
    """One recording: truth, gap before and after, what is said, the judgement."""
    true = draw["true"]
    sizes = " + ".join(f"{name} {size:.1f}" for name, size in true["sizes_mm"].items())
    start = f"{draw['kind']} {draw['number']}: {sizes or 'nothing'} mm, {true['left_mm']:.1f} left"
    if "refused" in draw:
        return f"{start} | refused: {draw['refused']} | {draw['judged']}"
    gaps = ["{:.1f} [{:.1f}, {:.1f}]".format(*draw[name]) for name in ("before_mm", "after_mm")]
    said = [
        start,
        f"{' -> '.join(gaps)} over {draw['floor_mm']:.1f} (truly {true['noise_mm']:.1f})",
        " ".join("{" + ", ".join(members) + "}" for members in draw["sets"]) or "nothing named",
        f"{'UNKNOWN' if draw['unknown'] else 'not unknown'}, p {draw['unknown_p']:.3g}",
        *draw["warnings"],
        *(f"likeliest {name}" for name in draw["likeliest"]),
        draw["judged"],
    ]
    return " | ".join(said)


def answers(draws: Sequence[Mapping[str, Any]]) -> str:
    """How often each row is answered how."""
    rows = []
    for name in dict.fromkeys(draw["kind"] for draw in draws):
        found = Counter(draw["judged"] for draw in draws if draw["kind"] == name)
        counts = (found[answer] or "" for answer in ANSWERS)
        rows.append((ROWS[name].about, found.total(), *counts))
    return table(("row", "n", *ANSWERS), rows)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@SEED
@click.option("--rows", default="", help="Rows to draw, and how many of each; all if empty.")
@OUT
def main(seed: int, rows: str, out: Path) -> None:
    """Diagnose the recordings of each row, write a line for each, and judge the answers."""

    def make(name: str, number: int, folder: Path) -> dict[str, Any]:
        return judge(name, write_draw(seed, name, number, folder), folder)

    counts = {name: row.draws for name, row in ROWS.items()}
    if rows:
        asked = counts_by_name(rows, 0, list(ROWS), "row")
        counts = {name: count or counts[name] for name, count in asked.items()}
    shown = []
    for draw in kept_rows(out, counts, make):
        shown.append(draw)
        click.echo(line(draw))
    click.echo(answers(shown))


if __name__ == "__main__":
    main()
