"""The report page: one HTML file that needs nothing else."""

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from tofcorr.diagnosis.report.figures import svg_of
from tofcorr.diagnosis.report.result import Diagnosis
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.version import __version__

_TEMPLATE = "report.html.j2"


def render(diagnosis: Diagnosis, figures: Mapping[str, Figure]) -> str:
    """Return the page.

    Args:
        diagnosis: What was found.
        figures: Those of `tofcorr.diagnosis.report.figures.all_figures`.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["mm"] = _mm
    environment.filters["percent"] = _percent
    environment.filters["p"] = _p
    text = files("tofcorr.diagnosis.report").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    findings = diagnosis.to_mapping()
    return environment.from_string(text).render(
        **findings,
        parts=_parts(diagnosis),
        catalogue=CATALOGUE,
        figures={name: Markup(svg_of(figure)) for name, figure in figures.items()},
        provenance=_provenance(diagnosis),
        level=diagnosis.study.options.tests.level,
        tested=diagnosis.selection.tested,
        steps=diagnosis.gap_steps,
    )


def _parts(diagnosis: Diagnosis) -> list[tuple[str, float, float]]:
    """Return the parts of the gap in words, in mm, and as shares of its square."""
    gap = diagnosis.gap
    total = max(gap.before**2, 1e-18)
    parts = (
        ("between images (whole images shifted or tilted)", gap.between_images),
        ("the same in every image (fixed pattern)", gap.fixed_pattern),
        ("within images, changing from one to the next", gap.within_images),
    )
    return [(words, 1e3 * size, size**2 / total) for words, size in parts]


def _provenance(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    study = diagnosis.study
    observations, options = study.observations, study.options
    recording = observations.recording
    noise = study.fit.noise
    floor = (
        f"{noise.repeats} frames taken without moving"
        if noise.repeats
        else "pixels three apart within one image; what they do not share of an effect counts as "
        "noise, so the floor is an upper bound"
    )
    return [
        ("recording", recording.path.name),
        (
            "frames, poses, pixels used",
            f"{observations.num_frames}, {observations.num_units}, {len(observations.measured)}",
        ),
        ("camera", f"{recording.camera.width} x {recording.camera.height}"),
        ("base model", ", ".join(_base_terms(diagnosis)) or "a constant alone"),
        ("hand-eye transform", "estimated" if study.fit.model.hand_eye_free else "fixed"),
        ("noise floor from", floor),
        ("scatter of poses", ", ".join(f"{1e3 * sd:.2f}" for sd in study.blocks.pose_sd) + " mm"),
        ("dispersion of scores", f"{study.blocks.dispersion:.2f}"),
        ("folds, sign flips, bootstraps", _counts(diagnosis)),
        ("seed", str(options.seed)),
        ("versions", f"tofcorr {__version__}, torch {torch.__version__}, NumPy {np.__version__}"),
    ]


def _base_terms(diagnosis: Diagnosis) -> list[str]:
    model = diagnosis.study.fit.model
    return [f"{t.group} ({len(t.symbols)})" for t in (*model.signal_terms, *model.pixel_terms)]


def _counts(diagnosis: Diagnosis) -> str:
    options = diagnosis.study.options
    return f"{options.tests.folds}, {options.tests.flips}, {options.bootstraps}"


def _mm(value: Any) -> str:  # noqa: ANN401 - a number, or None where there is none
    if value is None:
        return "–"
    text = f"{value:.1f}" if abs(value) >= 0.95 else f"{value:.2f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _p(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
