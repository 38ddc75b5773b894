"""Writes the files of the report."""

import json
from pathlib import Path

from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.found_sensor import sensor_of
from tofcorr.options import dump_yaml
from tofcorr.sensor.sensor_file import FILE_NAME, sensor_text


def write_report(result: DiagnosisResult, folder: Path) -> None:
    """Write `diagnosis.json`, `sensor.yaml`, and `report.html` and `tb/` if wanted.

    Where the built-in simulator was used, `simulator_with_effects.yaml` is written too.

    Args:
        result: What was found.
        folder: Where to write; it exists.

    Raises:
        OSError: It cannot be written.
    """
    mapping = result.to_mapping()
    sensor = sensor_of(result.evidence, result.simulator, result.observables)
    texts = {
        FILE_NAME: sensor_text(sensor),
        "diagnosis.json": json.dumps(mapping, indent=1, ensure_ascii=False, allow_nan=False) + "\n",
    }
    if result.simulator is not None:
        texts["simulator_with_effects.yaml"] = dump_yaml(result.simulator.to_mapping())
    if result.options.page:
        # matplotlib and TensorBoard take half as long to import as torch.
        from tofcorr.diagnosis.report.monitor import write_events
        from tofcorr.diagnosis.report.page import draw_figures, render

        texts["report.html"] = render(result, draw_figures(result))
        write_events(result, folder / "tb")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
