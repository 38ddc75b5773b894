"""A new format of export, written by a module and by the command."""

from pathlib import Path

import tofcorr
from tofcorr.cli.main import group
from tofcorr.correction.state import save_calibration

matrix = ((9.0, 0.0, 3.0), (0.0, 9.0, 2.0), (0.0, 0.0, 1.0))
camera = tofcorr.CameraIntrinsics(width=7, height=5, matrix=matrix)
module = tofcorr.DepthCorrection(camera, [{"kind": "distance_polynomial", "degree": 2}])
module.export("ros_command", "module.sh")
Path("run").mkdir()
save_calibration("run/state.pt", module.to_state())
words = "export --run run --format ros_command --out command.sh"
group(words.split(), standalone_mode=False)
group(["export", "--help"], standalone_mode=False)
