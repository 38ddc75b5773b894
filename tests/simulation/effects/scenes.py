"""A recording without noise, for the effect that is added to it."""

from pathlib import Path
from typing import Any

import torch
from diagnosed_recordings import measured, recorded, simulator, true_inputs

from tofcorr.data.recording import Recording
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.options import SimulatorOptions

# The plain sensor has no delays here: an effect that moves edges would change those of amplitude.
FEW = {
    "sensor": {"delays": {"constant_mm": 0, "clock_deviation": 0, "pixel": {}, "amplitude": {}}},
    "shots": [{"target": "checkerboard", "poses": 8}],
    "robot": {"repeatability_mm": 0.0, "repeatability_mrad": 0.0},
}


class Scene:
    """A noise-free recording without effects, and how to record it with one."""

    def __init__(self, folder: Path, changes: dict[str, Any]) -> None:
        self.folder, self.changes = folder, changes
        self.options: SimulatorOptions = simulator(7, (), changes)
        self.plain = self.record("plain", [])
        self.inputs: EffectInputs = true_inputs(self.plain, self.options)

    def record(self, name: str, effects: list[dict[str, Any]]) -> Recording:
        folder = self.folder / name
        return recorded(folder, 7, effects, self.changes, noise=False)

    def change(self, effect: CatalogueEffect) -> torch.Tensor:
        """Return by how much an effect changes the measured distances, shape (M,)."""
        entry = effect.to_mapping()
        if isinstance(effect, MapEffect):
            entry = effect.listed(decimals=20)  # A float64 of 0.1 mm has no more.
        simulated = self.record(f"with_{effect.name}_{torch.rand(()).item()}", [entry])
        return measured(simulated) - measured(self.plain)


def plain_inputs(folder: Path, target: str, poses: int) -> EffectInputs:
    """Return what is true of a few noise-free poses of a camera without effects."""
    few = {"shots": [{"target": target, "poses": poses}]}
    recording = recorded(folder / "few", 5, [], few, noise=False)
    return true_inputs(recording, simulator(5, [], few))
