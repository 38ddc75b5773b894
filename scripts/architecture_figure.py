"""Draw the figures of docs/architecture.md: the rooms of the package, and how a frame flows.

    python scripts/architecture_figure.py

The layers are read from pyproject.toml, where import-linter holds them; a test compares the files.
"""

import tomllib
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "docs" / "assets"

PURPOSES = {
    "__main__": "python -m tofcorr",
    "cli": "commands: parse, call one function, print",
    "examples": "small input to start from, in the formats of other programs",
    "module": "DepthCorrection, an nn.Module to fit, differentiate and save",
    "diagnosis": "where simulator and recording differ, and which effect is missing",
    "sensor": "a camera as it was found, and what it measures of any scene",
    "observables": "noise, missing pixels and amplitude, measured and compared",
    "comparison": "models side by side: evaluate, select",
    "drift": "does a calibration still hold",
    "live": "calibration while one records",
    "training": "a run: split, fit, uncertainty, report, figures",
    "fit": "from pixels to the parameters of one model",
    "plausibility": "can a recording be what it says; asked before any fit",
    "pixels": "which pixels and images count, and how much",
    "estimation": "moments, solvers, covariance; knows no files",
    "importing": "other programs' data become recordings",
    "simulation": "light, sensor, effects; knows no error term",
    "data": "recordings on disk: read, check, write",
    "correction": "calibration, runtime corrector, exports",
    "scene_light": "what the scene does to light, found in one frame",
    "error_terms": "E = D + P + I (+ conditions), one term a file",
    "geometry": "rays, planes, rigid transforms",
    "pages": "one dress for every page and picture",
    "conditions": "names of a frame's circumstances",
    "options": "configurations: frozen, checked",
    "files": "whole or not at all; damage is noticed",
    "errors": "what a user can cause, and mend",
    "digits": "numbers with the digits that are known",
    "progress": "bars, log lines, TensorBoard files",
    "version": "one number",
}
"""One line for every room."""

COLOURS = {
    "front": ("#e8eaf6", "#3949ab"),
    "findings": ("#fff3e0", "#ef6c00"),
    "mathematics": ("#e0f2f1", "#00796b"),
    "data": ("#f3e5f5", "#7b1fa2"),
    "ground": ("#eceff1", "#546e7a"),
}
GROUPS = {
    "front": ("__main__", "cli", "examples", "module"),
    "findings": ("diagnosis", "sensor", "observables", "comparison", "drift", "live", "training"),
    "mathematics": (
        "fit",
        "plausibility",
        "pixels",
        "estimation",
        "scene_light",
        "error_terms",
        "geometry",
    ),
    "data": ("importing", "simulation", "data", "correction"),
    "ground": (
        "pages",
        "conditions",
        "digits",
        "files",
        "options",
        "progress",
        "errors",
        "version",
    ),
}
_GROUP_OF = {room: group for group, rooms in GROUPS.items() for room in rooms}

_WIDTH, _LEFT, _ROW, _GAP = 980, 24, 50, 10
_SANS = "system-ui, -apple-system, Segoe UI, Roboto, DejaVu Sans, Arial, sans-serif"
_MONO = "ui-monospace, Menlo, Consolas, DejaVu Sans Mono, monospace"
_INK, _SOFT = "#263238", "#607d8b"
_Style = dict[str, str | float]
_PLAIN: _Style = {"fill": _INK, "font_family": _SANS}


def layers() -> list[list[str]]:
    """Return the layers of pyproject.toml from top to bottom, each as its rooms side by side."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    stacked = next(one for one in contracts if one["type"] == "layers")["layers"]
    return [[room.strip() for room in layer.split("|")] for layer in stacked]


def rooms_figure() -> str:
    """Return the SVG of the rooms: each imports from those below it."""
    stacked = layers()
    inner = _WIDTH - 2 * _LEFT - 70
    drawn = [
        _text(_LEFT, 38, "Rooms of tofcorr", size=20, style={"font_weight": 600}),
        _text(
            _WIDTH - _LEFT,
            38,
            "each imports only from rooms below it",
            size=13,
            style={"text_anchor": "end"},
        ),
    ]
    top = 60.0
    for rooms in stacked:
        width = (inner - _GAP * (len(rooms) - 1)) / len(rooms)
        for number, room in enumerate(rooms):
            drawn += _room(_LEFT + number * (width + _GAP), top, width, room)
        top += _ROW + _GAP
    middle = _WIDTH - _LEFT - 26
    drawn.append(_arrow(middle, 66, middle, top - _GAP - 4))
    drawn.append(
        _text(
            middle + 10, 62 + top / 2, "imports", size=13, style={"text_anchor": "middle"}, turn=90
        )
    )
    x = float(_LEFT)
    for group, (fill, line) in COLOURS.items():
        drawn.append(_box(x, top + 4, 14, 14, fill=fill, line=line, round_by=3))
        drawn.append(_text(x + 20, top + 16, group, size=12, style={"fill": _SOFT}))
        x += 46 + 7.2 * len(group)
    return _svg(_WIDTH, top + 44, drawn)


def _room(x: float, y: float, width: float, room: str) -> list[str]:
    fill, line = COLOURS[_GROUP_OF[room]]
    box = _box(x, y, width, _ROW, fill=fill, line=line)
    if width > _WIDTH / 2:
        name = _text(x + 16, y + 31, room, size=16, style=_name(line))
        return [box, name, _text(x + 190, y + 31, PURPOSES[room], size=14)]
    name = _text(x + 14, y + 21, room, size=15, style=_name(line))
    return [box, name, _text(x + 14, y + 40, PURPOSES[room], size=12.5)]


_FLOWS = (
    (
        "train",
        "findings",
        (
            ("recording", "depth, amplitude,", "poses, planes"),
            ("data + pixels", "checked, streamed,", "masked, split"),
            ("estimation", "one pass: moments;", "Gauss-Newton on these"),
            ("training", "held-out errors,", "intervals, advice"),
            ("run/", "corrector.ts, report,", "calibration.yaml"),
        ),
    ),
    (
        "correct",
        "mathematics",
        (
            ("frame", "depth and amplitude", "from the camera"),
            ("geometry", "radial distance", "along each ray"),
            ("error_terms", "E from distance, pixel", "and amplitude"),
            ("correction", "measured minus E;", "inside the domain?"),
            ("result", "corrected depth,", "valid pixels, points"),
        ),
    ),
    (
        "diagnose",
        "data",
        (
            ("recording", "and a simulator,", "given or fitted"),
            ("base model", "refitted in the", "forward form"),
            ("sums", "every pose, every", "effect: one pass"),
            ("findings", "where, which, how far,", "on held-out poses"),
            ("report/", "verdict, intervals,", "simulator with effects"),
        ),
    ),
)


def flow_figure() -> str:
    """Return the SVG of how a frame flows through train, correct and diagnose."""
    width, height, step, first = 166, 84, 186, 56
    drawn = []
    for row, (name, group, stops) in enumerate(_FLOWS):
        fill, line = COLOURS[group]
        top = first + row * (height + 62)
        drawn.append(_text(_LEFT, top - 14, name, size=18, style=_name(line)))
        for number, (title, *words) in enumerate(stops):
            x = _LEFT + number * step
            end = number in (0, len(stops) - 1)
            drawn.append(_box(x, top, width, height, fill="#ffffff" if end else fill, line=line))
            drawn.append(_text(x + 12, top + 26, title, size=15, style=_name(line)))
            for index, word in enumerate(words):
                drawn.append(_text(x + 12, top + 48 + 18 * index, word, size=12.5))
            if number:
                middle = top + height / 2
                drawn.append(_arrow(x - step + width + 2, middle, x - 3, middle))
    return _svg(_LEFT * 2 + 4 * step + width, first + 3 * height + 2 * 62 + 30, drawn)


def _text(
    x: float, y: float, words: str, *, size: float, turn: int = 0, style: _Style = _PLAIN
) -> str:
    place: _Style = {"x": x, "y": y, "font_size": size}
    if turn:
        place["transform"] = f"rotate({turn} {x:g} {y:g})"
    return _tag("text", escape(words), **(place | _PLAIN | style))


def _name(colour: str) -> _Style:
    """Return the style of a room's name."""
    return {"font_weight": 600, "fill": colour, "font_family": _MONO}


def _box(
    x: float, y: float, width: float, height: float, *, fill: str, line: str, round_by: float = 7
) -> str:
    place = {"x": x, "y": y, "width": width, "height": height, "rx": round_by}
    return _tag("rect", **place, fill=fill, stroke=line, stroke_width=1.4)


def _arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    ends = {"x1": x1, "y1": y1, "x2": x2, "y2": y2}
    return _tag("line", **ends, stroke=_SOFT, stroke_width=1.6, marker_end="url(#head)")


def _svg(width: float, height: float, drawn: list[str]) -> str:
    head = _tag("path", d="M0 0 L8 4 L0 8 z", fill=_SOFT)
    marker = {"id": "head", "viewBox": "0 0 8 8", "refX": 7, "refY": 4}
    marker |= {"markerWidth": 7, "markerHeight": 7, "orient": "auto"}
    paper = _tag("rect", width=width, height=height, rx=12, fill="#ffffff")
    inside = [_tag("defs", _tag("marker", head, **marker)), paper, *drawn]
    whole = {"xmlns": "http://www.w3.org/2000/svg", "viewBox": f"0 0 {width:g} {height:g}"}
    return _tag("svg", "\n" + "\n".join(inside) + "\n", **whole) + "\n"


def _tag(name: str, content: str = "", /, **attributes: str | float) -> str:
    """Return an element; underscores in the names of attributes become hyphens."""
    words = [
        f"{key.replace('_', '-')}={quoteattr(value if isinstance(value, str) else f'{value:g}')}"
        for key, value in attributes.items()
    ]
    return f"<{' '.join([name, *words])}>{content}</{name}>"


FIGURES = {"rooms.svg": rooms_figure, "flow.svg": flow_figure}
"""File names below docs/assets, and what draws them."""


def main() -> None:
    """Write the figures."""
    ASSETS.mkdir(parents=True, exist_ok=True)
    for name, draw in FIGURES.items():
        (ASSETS / name).write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
