"""What a diagnosis writes: the page, `diagnosis.json`, `sensor.yaml`, TensorBoard's files."""

import json
import math
from collections.abc import Mapping
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.words import (
    FINDINGS,
    STAGE_WORDS,
    biases_of,
    effect_words,
    least_p,
    p_words,
    percent,
    stages_shown,
)
from tofcorr.diagnosis.rerun.sensor import sensor_of
from tofcorr.digits import decimals, known, known_interval
from tofcorr.observables.pairs import LEAST_P
from tofcorr.options import dump_yaml
from tofcorr.sensor.sensor_file import FILE_NAME, sensor_text
from tofcorr.simulation.effects.registry import CATALOGUE
from tofcorr.training.monitor import event_writer
from tofcorr.version import __version__


def write_report(result: DiagnosisResult, folder: Path) -> None:
    """Write `diagnosis.json`, `sensor.yaml`, and `report.html` and `tb/` if wanted.

    Where the built-in simulator was used, `simulator_with_effects.yaml` is written too.

    Args:
        result: What was found.
        folder: Where to write; it exists.

    Raises:
        OSError: It cannot be written.
    """
    findings = json.dumps(result.to_mapping(), indent=1, ensure_ascii=False, allow_nan=False)
    seen = result.evidence
    sensor = sensor_of(seen.study, seen.named, result.simulator, result.observables, seen.patterns)
    texts = {"diagnosis.json": findings + "\n", FILE_NAME: sensor_text(sensor)}
    if result.simulator is not None:
        texts["simulator_with_effects.yaml"] = dump_yaml(result.simulator.to_mapping())
    if result.options.page:
        texts["report.html"] = render(result)
        write_events(result, folder / "tb")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def render(result: DiagnosisResult) -> str:
    """Return the page: one HTML file that needs nothing else."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    from tofcorr.diagnosis.report.figures import svg_of

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "mm": _mm,
        "known": known,
        "known_interval": known_interval,
        "percent": lambda share: "–" if share is None else percent(share),
        "p": lambda p: "–" if p is None else p_words(p, least_p(result)).removeprefix("= "),
        "effect": partial(effect_words, result.evidence.study),
        "p_of_draws": lambda p: p_words(p, LEAST_P),
        "with_digits": _with_digits,
    }
    folder = files("tofcorr.diagnosis.report")
    template, style = (
        folder.joinpath(f"report.{n}").read_text("utf-8") for n in ("html.j2", "css")
    )
    return environment.from_string(template).render(
        style=Markup(style),
        **result.to_mapping(),
        components=_components(result),
        catalogue=CATALOGUE,
        pictures={
            name: (Markup(svg_of(figure)), *FINDINGS.get(name, lambda _: ("", ""))(result))
            for name, figure in result.all_figures().items()
        },
        stage_words=STAGE_WORDS,
        provenance=_provenance(result),
        level=result.options.tests.level,
        tested=result.tested,
        hand_eye_free=result.evidence.study.fit.model.hand_eye_free,
        saturated_missing=result.observables.real_dropouts.saturated_missing,
    )


def _components(result: DiagnosisResult) -> list[tuple[str, float, float]]:
    """Return the components of the gap in words, in mm, and as shares of its square."""
    gap = result.gap
    components = {
        "between images (whole images shifted or tilted)": gap.between_images,
        "the same in every image (fixed pattern)": gap.fixed_pattern,
        "within images, or different between frames of a pose": gap.within_images,
    }
    total = max(gap.before**2, 1e-18)
    return [(words, 1e3 * size, size**2 / total) for words, size in components.items()]


def _provenance(result: DiagnosisResult) -> list[tuple[str, str]]:
    study, options = result.evidence.study, result.options
    observations, sums = study.observations, study.sums
    recording = observations.recording
    floor = (
        "differences between pixels three apart in one image: an upper bound, because it "
        "contains every effect that such pixels do not share"
    )
    if study.fit.noise.repeats:
        floor = f"{study.fit.noise.repeats} frames taken without moving"
    terms = [f"{term.group} ({len(term.symbols)})" for term in study.fit.model.terms]
    if study.pattern is not None:
        terms.append("fixed pattern")
    spread = ", ".join(f"{1e3 * sd:.2f}" for sd in sums.pose_sd)
    return [
        ("recording", recording.path.name),
        (
            "frames, poses, pixels used",
            f"{observations.num_frames}, {observations.num_units}, {len(observations.measured)}",
        ),
        ("camera", f"{recording.camera.width} x {recording.camera.height} pixels"),
        ("base model", ", ".join(terms) or "a constant alone"),
        ("hand-eye transform", "estimated" if study.fit.model.hand_eye_free else "fixed"),
        ("noise floor from", floor),
        ("standard deviation of poses: offset, two tilts at the image's edge", f"{spread} mm"),
        ("variance of the scores over that of independent noise", f"{sums.dispersion:.2f}"),
        (
            "folds, sign flips, bootstraps",
            f"{options.tests.folds}, {options.tests.flips}, {options.bootstraps}",
        ),
        ("seed", str(options.seed)),
        ("versions", f"tofcorr {__version__}, torch {torch.__version__}, NumPy {np.__version__}"),
    ]


def _mm(value: float | None) -> str:
    if value is None:
        return "–"
    text = f"{value:.1f}" if round(abs(value), 1) >= 1 else f"{value:.2f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _with_digits(entry: Mapping[str, Any]) -> tuple[str, str]:
    """Return a fitted value and its interval with the digits that are known."""
    value, ends = entry["value"], entry["ci"]
    if value is None:
        return "–", ""
    interval = (value, value) if ends is None or None in ends else (ends[0], ends[1])
    largest = max(abs(value), *map(abs, interval))
    # Up to five digits before or after the point are read at a glance.
    if largest == 0 or 1e-3 <= largest < 1e5:
        numbers = [known(number, interval, 6) for number in (value, *interval)]
    else:  # Pixel terms are as small as 1e-12 m / pixel^4.
        digits = max(math.floor(math.log10(largest)) + decimals(interval, 16), 1)
        numbers = [f"{number:.{min(digits, 3)}e}" for number in (value, *interval)]
    return numbers[0], "" if interval[0] == interval[1] else " to ".join(numbers[1:])


def write_events(result: DiagnosisResult, folder: Path | str) -> None:
    """Write verdict, gap, effects, and the residual along covariates and poses for TensorBoard.

    A curve has one step for each bin of its covariate, or for each pose; the page has pictures.

    Args:
        result: What was found.
        folder: Usually REPORT/tb; made if it is missing.
    """
    gap, known_stages = result.gap, [one for one in result.stages if one.gap is not None]
    numbers = {f"stage_mm/{stage.name}": 1e3 * (stage.gap or 0.0) for stage in known_stages}
    numbers |= {f"gap_mm/{part}": 1e3 * getattr(gap, part) for part in ("before", "after", "floor")}
    numbers |= {f"score/{entry.name}": entry.score for entry in result.ranking}
    numbers |= {f"share/{cause.cause}": cause.share for cause in result.shares}
    curves: dict[str, list[float]] = {}
    for stage in stages_shown(result):
        curves[f"pose_mm/{stage.name}"] = stage.offsets.tolist()
        for covariate, regions in stage.by_covariate().items():
            curves[f"bias_mm_{stage.name}/{covariate}"] = list(map(float, biases_of(regions)))
    with event_writer(folder) as writer:
        writer.add_text("verdict", result.verdict)
        for tag, number in numbers.items():
            writer.add_scalar(tag, number)
        for tag, values in curves.items():
            for step, value in enumerate(values):
                if math.isfinite(value):
                    writer.add_scalar(tag, 1e3 * value, step)
