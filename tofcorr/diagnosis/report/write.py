"""Writes the files of the report."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.found_sensor import sensor_of
from tofcorr.options import dump_yaml
from tofcorr.pixels.two_at_once import all_at_once
from tofcorr.sensor.sensor_file import FILE_NAME, sensor_text
from tofcorr.simulation.options import SimulatorOptions


class Texts(NamedTuple):
    """The text files of the report but its page, by name, and the page's figures as SVG."""

    files: dict[str, str]
    figures: dict[str, str]


def texts_of(result: DiagnosisResult) -> Texts:
    """Return the texts of the report; the page has figures if it is wanted."""
    drawings: dict[str, Callable[[], str]] = {}
    if result.options.page:
        # matplotlib and TensorBoard take half as long to import as torch.
        from tofcorr.diagnosis.report.page import drawings as drawings_of

        drawings = drawings_of(result)
    files = {FILE_NAME: partial(_sensor, result), "diagnosis.json": partial(_findings, result)}
    if result.simulator is not None:
        files["simulator_with_effects.yaml"] = partial(_simulator, result.simulator)
    found = all_at_once([*drawings.values(), *files.values()])
    figures = dict(zip(drawings, found[: len(drawings)], strict=True))
    return Texts(dict(zip(files, found[len(drawings) :], strict=True)), figures)


def _sensor(result: DiagnosisResult) -> str:
    return sensor_text(sensor_of(result.evidence, result.simulator, result.observables))


def _simulator(options: SimulatorOptions) -> str:
    return dump_yaml(options.to_mapping())


def _findings(result: DiagnosisResult) -> str:
    mapping = result.to_mapping()
    return json.dumps(mapping, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_report(result: DiagnosisResult, folder: Path, texts: Texts) -> None:
    """Write `diagnosis.json`, `sensor.yaml`, and `report.html` and `tb/` if wanted.

    Where the built-in simulator was used, `simulator_with_effects.yaml` is written too.

    Args:
        result: What was found.
        folder: Where to write; it exists.
        texts: Those of `texts_of`.

    Raises:
        OSError: It cannot be written.
    """
    for name, text in texts.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    if result.options.page:
        from tofcorr.diagnosis.report.monitor import write_events
        from tofcorr.diagnosis.report.page import render

        page = render(result, texts.figures)
        (folder / "report.html").write_text(page, encoding="utf-8")
        write_events(result, folder / "tb")
