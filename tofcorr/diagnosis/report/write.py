"""The report folder, written whole or not at all."""

import json
from pathlib import Path

from tofcorr.data.staging import StagedFolder
from tofcorr.diagnosis.report.figures import all_figures
from tofcorr.diagnosis.report.monitor import write_events
from tofcorr.diagnosis.report.page import render
from tofcorr.diagnosis.report.result import Diagnosis
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of
from tofcorr.options import dump_yaml
from tofcorr.simulation.options import SimulatorOptions


def write_report(
    diagnosis: Diagnosis, out: Path | str, simulator: SimulatorOptions | None = None
) -> None:
    """Write `diagnosis.json`, `simulator_with_effects.yaml`, and `report.html` and `tb/` if wanted.

    Args:
        diagnosis: What was found.
        out: Folder of the report; nothing may be there yet.
        simulator: What was under diagnosis; None: one fitted to the recording.

    Raises:
        CalibrationDataError: `out` exists, or cannot be written.
    """
    with StagedFolder(out) as stage:
        text = json.dumps(diagnosis.to_mapping(), indent=1, ensure_ascii=False, allow_nan=False)
        (stage.folder / "diagnosis.json").write_text(text + "\n", encoding="utf-8")
        extended = simulator_of(diagnosis.study, diagnosis.selection, simulator)
        (stage.folder / "simulator_with_effects.yaml").write_text(
            dump_yaml(extended.to_mapping()), encoding="utf-8"
        )
        if diagnosis.study.options.page:
            figures = all_figures(diagnosis)
            (stage.folder / "report.html").write_text(render(diagnosis, figures), encoding="utf-8")
            write_events(diagnosis, figures, stage.folder / "tb")
