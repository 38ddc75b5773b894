# ruff: noqa: T201 - its output is looked at
"""A new term: trained, loaded as a module, and deployed."""

import json

import torch

import tofcorr

wall = tofcorr.simulate("../wall.yaml", "wall")
terms = [{"kind": "illumination_baseline"}, {"kind": "pixel_polynomial"}]
options = {"name": "B", "model": {"terms": terms}, "advice": 0}
report = tofcorr.train(wall, options, out="run").report
module = tofcorr.DepthCorrection.load("run")
other = tofcorr.DepthCorrection(wall.camera, terms)
other.load_state_dict(module.state_dict())
depth = torch.tensor(wall.depth[:2])
corrected, _ = torch.jit.load("run/corrector.ts")(depth, depth)
found = {
    "errors": report["error_mm"],
    "symbols": module.error_model.symbols(),
    "same": torch.equal(other(depth), module(depth)),
    "apart": float((module(depth) - corrected).nan_to_num().abs().max()),
}
print(json.dumps(found))
