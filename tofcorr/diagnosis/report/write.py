"""Writes the report folder, whole or not at all."""

import json
from collections.abc import Mapping
from pathlib import Path

from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.found_sensor import sensor_of
from tofcorr.files.staged_folder import StagedFolder
from tofcorr.options import dump_yaml
from tofcorr.sensor.sensor_file import FILE_NAME, sensor_text


def drawn_figures(result: DiagnosisResult) -> dict[str, str]:
    """Return the figures of the page as SVG elements, by name; none if no page is wanted."""
    if not result.options.page:
        return {}
    # matplotlib and TensorBoard take half as long to import as torch.
    from tofcorr.diagnosis.report.page import drawn

    return drawn(result)


def write_report(result: DiagnosisResult, out: Path | str, figures: Mapping[str, str]) -> None:
    """Write `diagnosis.json`, `sensor.yaml`, and `report.html` and `tb/` if wanted.

    Where the built-in simulator was used, `simulator_with_effects.yaml` is written too.

    Args:
        result: What was found.
        out: Folder of the report; nothing may be there yet.
        figures: Those of `drawn_figures`.

    Raises:
        CalibrationDataError: `out` exists, or cannot be written.
    """
    with StagedFolder(out) as stage:
        text = json.dumps(result.to_mapping(), indent=1, ensure_ascii=False, allow_nan=False)
        (stage.folder / "diagnosis.json").write_text(text + "\n", encoding="utf-8")
        if result.simulator is not None:
            (stage.folder / "simulator_with_effects.yaml").write_text(
                dump_yaml(result.simulator.to_mapping()), encoding="utf-8"
            )
        sensor = sensor_of(result.evidence, result.simulator, result.observables)
        (stage.folder / FILE_NAME).write_text(sensor_text(sensor), encoding="utf-8")
        if result.options.page:
            from tofcorr.diagnosis.report.monitor import write_events
            from tofcorr.diagnosis.report.page import render

            (stage.folder / "report.html").write_text(render(result, figures), encoding="utf-8")
            write_events(result, stage.folder / "tb")
