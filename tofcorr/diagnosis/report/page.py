"""The report page: one HTML file that needs nothing else."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from tofcorr.diagnosis.report.caption import Caption
from tofcorr.diagnosis.report.captions import caption_of
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.stage_figures import STAGE_WORDS
from tofcorr.diagnosis.report.style import svg_of
from tofcorr.diagnosis.report.words import effect_words, p_words, percent
from tofcorr.digits import decimals, known, known_interval
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.version import __version__

_TEMPLATE = "report.html.j2"
_STYLE = "report.css"
# Fitted values between these are written without an exponent. Chosen: up to five digits before or
# after the point are read at a glance.
_LEAST_PLAIN, _MOST_PLAIN = 1e-3, 1e5
# Decimals of a fitted value, at the most: pixel terms are as small as 1e-12 m / pixel^4. Chosen.
_MOST_DECIMALS = 16


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure as an SVG element, and its words."""

    svg: Markup
    caption: Caption


def draw_figures(result: DiagnosisResult) -> dict[str, str]:
    """Return each of `DiagnosisResult.all_figures` as an SVG element."""
    return {name: svg_of(draw()) for name, draw in result.drawings().items()}


def render(result: DiagnosisResult, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        result: What was found.
        figures: Its figures as SVG elements.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["mm"] = _mm
    environment.filters["known"] = known
    environment.filters["known_interval"] = known_interval
    environment.filters["percent"] = _percent
    environment.filters["p"] = lambda p: (
        "–" if p is None else p_words(p, result.least_p_value).removeprefix("= ")
    )
    environment.filters["effect"] = partial(effect_words, result.evidence.study)
    environment.filters["with_digits"] = _with_digits
    folder = files("tofcorr.diagnosis.report")
    text, style = (folder.joinpath(name).read_text("utf-8") for name in (_TEMPLATE, _STYLE))
    return environment.from_string(text).render(
        style=Markup(style),
        **result.to_mapping(),
        components=_components(result),
        catalogue=CATALOGUE,
        pictures={
            name: Picture(svg=Markup(svg), caption=caption_of(name, result))
            for name, svg in figures.items()
        },
        stage_words=STAGE_WORDS,
        provenance=_provenance(result),
        level=result.options.tests.level,
        tested=result.tested,
    )


def _components(result: DiagnosisResult) -> list[tuple[str, float, float]]:
    """Return the components of the gap in words, in mm, and as shares of its square."""
    gap = result.gap
    total = max(gap.before**2, 1e-18)
    components = (
        ("between images (whole images shifted or tilted)", gap.between_images),
        ("the same in every image (fixed pattern)", gap.fixed_pattern),
        ("within images, or different between frames of a pose", gap.within_images),
    )
    return [(words, 1e3 * size, size**2 / total) for words, size in components]


def _provenance(result: DiagnosisResult) -> list[tuple[str, str]]:
    study, options = result.evidence.study, result.options
    observations, blocks = study.observations, study.system.blocks
    recording = observations.recording
    noise = study.fit.noise
    floor = (
        f"{noise.repeats} frames taken without moving"
        if noise.repeats
        else "differences between pixels three apart in one image: an upper bound, because it "
        "contains every effect that such pixels do not share"
    )
    spread = ", ".join(f"{1e3 * sd:.2f}" for sd in blocks.pose_sd)
    counts = f"{options.tests.folds}, {options.tests.flips}, {options.bootstraps}"
    return [
        ("recording", recording.path.name),
        (
            "frames, poses, pixels used",
            f"{observations.num_frames}, {observations.num_units}, {len(observations.measured)}",
        ),
        ("camera", f"{recording.camera.width} x {recording.camera.height} pixels"),
        ("base model", _base_model(result)),
        ("hand-eye transform", "estimated" if study.fit.model.hand_eye_free else "fixed"),
        ("noise floor from", floor),
        ("standard deviation of poses: offset, two tilts at the image's edge", f"{spread} mm"),
        ("variance of the scores over that of independent noise", f"{blocks.dispersion:.2f}"),
        ("folds, sign flips, bootstraps", counts),
        ("seed", str(options.seed)),
        ("versions", f"tofcorr {__version__}, torch {torch.__version__}, NumPy {np.__version__}"),
    ]


def _base_model(result: DiagnosisResult) -> str:
    """Return the groups of the base model's terms, with their numbers of coefficients."""
    study = result.evidence.study
    terms = [f"{term.group} ({len(term.symbols)})" for term in study.fit.model.terms]
    if study.pattern is not None:
        terms.append("fixed pattern")
    return ", ".join(terms) or "a constant alone"


def _mm(value: Any) -> str:  # noqa: ANN401 - a number, or None where there is none
    if value is None:
        return "–"
    text = f"{value:.1f}" if abs(value) >= 0.95 else f"{value:.2f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _percent(value: float | None) -> str:
    return "–" if value is None else percent(value)


def _with_digits(entry: Mapping[str, Any]) -> tuple[str, str]:
    """Return a fitted value and its interval with the digits that are known."""
    value, ends = entry["value"], entry["ci"]
    if value is None:
        return "–", ""
    interval = (value, value) if ends is None or None in ends else (ends[0], ends[1])
    largest = max(abs(value), *map(abs, interval))
    if largest == 0 or _LEAST_PLAIN <= largest < _MOST_PLAIN:
        numbers = [known(number, interval, 6) for number in (value, *interval)]
    else:
        digits = max(math.floor(math.log10(largest)) + decimals(interval, _MOST_DECIMALS), 1)
        numbers = [f"{number:.{min(digits, 3)}e}" for number in (value, *interval)]
    return numbers[0], "" if interval[0] == interval[1] else " to ".join(numbers[1:])
