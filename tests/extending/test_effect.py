"""A new effect is one file and one line of the registry."""

import copy
import json
from pathlib import Path

import diagnosed_recordings
from extended_package import extend

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

RUN = """
from pathlib import Path
import tofcorr
from tofcorr.cli.main import group
assert str(Path(tofcorr.__file__).parents[1]) == {root!r}
group(["simulate", "--config", "sim.yaml", "--out", "recording"], standalone_mode=False)
group(["diagnose", "--recording", "recording", "--config", "diagnose.yaml", "--out", "report"],
      standalone_mode=False)
"""


def test_a_new_effect_is_simulated_from_yaml_and_named_by_the_diagnosis(tmp_path: Path) -> None:
    package = extend(
        tmp_path,
        new_file=("simulation/effects/stripes.py", EFFECT),
        registry="simulation/effects/registry.py",
        before='    "timestamp_offset:TimestampOffsetEffect",',
        line='    "stripes:StripesEffect",',
    )
    simulator = copy.deepcopy(diagnosed_recordings.PLAIN)
    simulator |= {"effects": [{"name": "stripes", "height_m": 0.006}]}
    (tmp_path / "sim.yaml").write_text(dump_yaml(simulator), encoding="utf-8")
    diagnosis = {"catalogue": ["stripes", "incidence_angle"], "simulate_anew": False}
    diagnosis |= {"bootstraps": 19}
    (tmp_path / "diagnose.yaml").write_text(dump_yaml(diagnosis), encoding="utf-8")

    package.run(RUN.format(root=str(tmp_path)))

    report = json.loads((tmp_path / "report/diagnosis.json").read_text(encoding="utf-8"))
    assert report["effects"] == ["stripes"]
