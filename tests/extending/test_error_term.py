"""A new kind of error term is one file and one line of the registry."""

import json
from pathlib import Path

from extended_package import extend
from simulated_walls import simulated_wall

TERM = '''
"""An error proportional to the square root of the distance."""

from typing import Literal

from torch import Tensor

from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.term_options import BaseTermOptions


class RootOptions(BaseTermOptions):
    """Options of `Root`."""

    kind: Literal["root"] = "root"


class Root(SignalTerm):
    """One coefficient times the square root of the scaled distance, less one."""

    scale: Tensor

    def __init__(self, options: RootOptions, domain: Domain) -> None:
        super().__init__(options, "distance", ["root"])
        self.register_number("scale", domain.radial_distance.centre)

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        return ((radial_distance / self.scale).sqrt() - 1.0).unsqueeze(0)

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        return self.coefficients[0] * ((radial_distance / self.scale).sqrt() - 1.0)
'''

RUN = """
import json, sys, torch
from pathlib import Path
from tofcorr import DepthCorrection, Recording
from tofcorr.correction.state import load_calibration
from tofcorr.training.options import TrainingOptions
from tofcorr.training.run import train

wall, out = Recording.open(sys.argv[1]), Path(sys.argv[2])
terms = [{"kind": "root"}, {"kind": "pixel_polynomial"}]
options = TrainingOptions.from_mapping(
    {"name": "R", "model": {"terms": terms}, "advice": 0}, "test"
)
report = train(wall, options, out=out).report
module = DepthCorrection.load(out)
other = DepthCorrection(wall.camera, terms)
other.load_state_dict(module.state_dict())
depth = torch.tensor(wall.depth[:2])
corrected, _ = torch.jit.load(str(out / "corrector.ts"))(depth, depth)
print(json.dumps({
    "errors": report["error_mm"],
    "symbols": module.error_model.symbols(),
    "same": torch.equal(other(depth), module(depth)),
    "apart": float((module(depth) - corrected).nan_to_num().abs().max()),
}))
"""


def test_a_new_term_trains_loads_and_deploys(tmp_path: Path) -> None:
    simulated_wall(tmp_path / "wall")
    package = extend(
        tmp_path,
        ("error_terms/root.py", TERM),
        "error_terms/registry.py",
        '    ("warm_up", "WarmUpOptions", "WarmUp"),',
        '    ("root", "RootOptions", "Root"),',
    )
    code = f"import sys; sys.argv[1:] = {[str(tmp_path / 'wall'), str(tmp_path / 'run')]!r}\n"
    found = json.loads(package.run(code + RUN).splitlines()[-1])
    errors = found["errors"]
    assert errors["after"]["test"]["rms"] < errors["hand_eye_only"]["test"]["rms"]
    assert found["symbols"][:2] == ["c0", "root"]
    assert found["same"]
    assert found["apart"] < 1e-6
