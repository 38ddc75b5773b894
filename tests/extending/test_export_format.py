"""A new format of export is one file and one line of the registry."""

import json
from pathlib import Path

from extended_package import extend

FORMAT = '''
"""The coefficients as JSON."""

import json
from pathlib import Path

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.files.staged_file import staged_file
from tofcorr.correction.state import CalibrationState


def export_numbers(
    corrector: DepthCorrector, path: Path | str, reference: CalibrationState
) -> None:
    """Write the coefficients in a JSON file."""
    with staged_file(path) as staged:
        staged.write_text(json.dumps(reference.coefficients.tolist()), encoding="utf-8")
'''

RUN = """
import sys
from pathlib import Path
from click.testing import CliRunner
from tofcorr import CameraIntrinsics, DepthCorrection
from tofcorr.cli.export import command
from tofcorr.correction.state import save_calibration
from tofcorr.module.saving import to_state

camera = CameraIntrinsics(
    width=7, height=5, matrix=((9.0, 0.0, 3.0), (0.0, 9.0, 2.0), (0.0, 0.0, 1.0))
)
module = DepthCorrection(camera, [{"kind": "distance_polynomial", "degree": 2}])
module.export("numbers", "module.json")
Path("run").mkdir()
save_calibration("run/state.pt", to_state(module))
arguments = ["--run", "run", "--format", "numbers", "--out", "command.json"]
done = CliRunner().invoke(command, arguments)
assert done.exit_code == 0, done.output
help_text = " ".join(CliRunner().invoke(command, ["--help"]).output.split())
assert "numbers (.json): the coefficients." in help_text
"""


def test_a_new_format_is_written_by_the_module_and_by_the_command(tmp_path: Path) -> None:
    package = extend(
        tmp_path,
        ("correction/export/numbers.py", FORMAT),
        "correction/export/registry.py",
        '    Format("lut",',
        '    Format("numbers", ".json", "the coefficients"),',
    )
    package.run(RUN)
    for name in ("module.json", "command.json"):
        assert json.loads((tmp_path / name).read_text()) == [0.0, 0.0, 0.0]
