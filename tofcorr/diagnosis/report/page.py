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

from tofcorr.diagnosis.findings.effect_comparison import closed_gap
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.words import (
    SMALL,
    STAGE_WORDS,
    along,
    biases_of,
    cause_words,
    effect_words,
    least_p,
    mm,
    p_words,
    percent,
    pose_errors,
    share_words,
    sized,
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
    study, named = result.evidence.study, result.evidence.named
    environment.filters |= {
        "mm": _mm,
        "metres": mm,
        "known": known,
        "known_interval": known_interval,
        "sized": sized,
        "percent": lambda share: "–" if share is None else percent(share),
        "share": share_words,
        "small": lambda share: abs(share) < SMALL,
        "negative": lambda share: share < 0 and percent(share) != "0 %",
        "p": lambda p: "–" if p is None else p_words(p, least_p(result)).removeprefix("= "),
        "effect": partial(effect_words, study),
        "cause": partial(cause_words, study),
        "along": along,
        "p_of_draws": lambda p: p_words(p, LEAST_P),
        "with_digits": _with_digits,
    }
    folder, tests = files("tofcorr.diagnosis.report"), named.first.tests
    template, style = (
        folder.joinpath(f"report.{n}").read_text("utf-8") for n in ("html.j2", "css")
    )
    return environment.from_string(template).render(
        style=Markup(style),
        **result.to_mapping(),
        result=result,
        study=study,
        options=result.options,
        gap=result.gap,
        recording=study.observations.recording,
        shown=stages_shown(result),
        pose_errors=pose_errors(result),
        closed={n: closed_gap(study, named.first, test)[1] for n, test in tests.items()},
        catalogue=CATALOGUE,
        pictures={name: Markup(svg_of(own)) for name, own in result.all_figures().items()},
        stage_words=STAGE_WORDS,
        versions=f"tofcorr {__version__}, torch {torch.__version__}, NumPy {np.__version__}",
        hand_eye_free=study.fit.model.hand_eye_free,
        saturated_missing=result.observables.real_dropouts.saturated_missing,
    )


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
