"""An effect that the package lacks, and a simulation and a diagnosis that use it."""

import copy

import diagnosed_recordings
from extended_package import Addition

from tofcorr.options import dump_yaml

EFFECT = '''
"""A pattern of stripes over the image."""

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, LinearDelay
from tofcorr.simulation.effects.inputs import EffectInputs


class StripesEffect(LinearDelay):
    """Stripes of six periods from the left to the right edge."""

    name = "stripes"
    summary = "stripes over the image"
    source = "invented for a test"
    remedy = "a white wall"

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        return (Coefficient("height_m", "m", 0.01),)

    def columns(self, inputs: EffectInputs) -> Tensor:
        return torch.cos(6 * torch.pi * inputs.columns)[:, None]
'''
STRIPES = Addition(
    path="simulation/effects/stripes.py",
    text=EFFECT,
    registry="simulation/effects/registry.py",
    before='    "timestamp_offset:TimestampOffsetEffect",',
    line='    "stripes:StripesEffect",',
)
SIMULATOR = copy.deepcopy(diagnosed_recordings.PLAIN) | {
    "effects": [{"name": "stripes", "height_m": 0.006}]
}
DIAGNOSIS = {
    "catalogue": ["stripes", "incidence_angle"],
    "simulate_anew": False,
    "page": False,
    "bootstraps": 19,
}
RUN = f"""
from pathlib import Path
from tofcorr.cli.main import group

Path("sim.yaml").write_text({dump_yaml(SIMULATOR)!r}, encoding="utf-8")
Path("diagnose.yaml").write_text({dump_yaml(DIAGNOSIS)!r}, encoding="utf-8")
group(["simulate", "--config", "sim.yaml", "--out", "recording"], standalone_mode=False)
group(["diagnose", "--recording", "recording", "--config", "diagnose.yaml", "--out", "report"],
      standalone_mode=False)
"""
