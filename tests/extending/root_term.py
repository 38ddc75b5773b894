"""An error term that the package lacks, and a training that uses it."""

import simulated_walls
from extended_package import Addition

TERM = '''
"""An error proportional to the square root of the distance."""

from typing import Literal

from torch import Tensor

from tofcorr.error_terms.base import BaseTermOptions, SignalTerm
from tofcorr.error_terms.base import Domain


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
ROOT_TERM = Addition(
    path="error_terms/root.py",
    text=TERM,
    registry="error_terms/registry.py",
    before='    ("condition_terms", "WarmUpOptions", "WarmUp"),',
    line='    ("root", "RootOptions", "Root"),',
)
RUN = f"""
import json, torch, tofcorr
from tofcorr import DepthCorrection

wall = tofcorr.simulate({simulated_walls.wall_options(1).model_dump(mode="json")!r}, "wall")
terms = [{{"kind": "root"}}, {{"kind": "pixel_polynomial"}}]
options = {{"name": "R", "model": {{"terms": terms}}, "advice": 0}}
report = tofcorr.train(wall, options, out="run").report
module = DepthCorrection.load("run")
other = DepthCorrection(wall.camera, terms)
other.load_state_dict(module.state_dict())
depth = torch.tensor(wall.depth[:2])
corrected, _ = torch.jit.load("run/corrector.ts")(depth, depth)
print(json.dumps({{
    "errors": report["error_mm"],
    "symbols": module.error_model.symbols(),
    "same": torch.equal(other(depth), module(depth)),
    "apart": float((module(depth) - corrected).nan_to_num().abs().max()),
}}))
"""
