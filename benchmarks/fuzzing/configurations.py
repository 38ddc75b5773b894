"""Targets: configurations, single options, sensors, and a simulator that runs."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml

import tofcorr
from benchmarks import tiny
from benchmarks.fuzzing.mutations import HOSTILE, change_bytes, change_tree
from benchmarks.fuzzing.target import Target, require_equal, stated
from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.options import Options, load_options, resolve_options, shipped_names
from tofcorr.options.shipped import shipped_file
from tofcorr.options.yaml_files import parse_yaml
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.options import TrainingOptions

_CLASSES: dict[str, type[Options]] = {
    "train": TrainingOptions,
    "evaluate": EvaluationOptions,
    "select": SelectionOptions,
    "diagnose": DiagnosisOptions,
    "simulate": SimulatorOptions,
}
# A simulator that would take more frames than this is only read, not run.
_MOST_FRAMES = 60


def targets(made: tiny.Tiny) -> list[Target]:
    """Return the targets."""
    found = [Target(f"{name} configuration", 5, _read(name, cls)) for name, cls in _CLASSES.items()]
    found.append(Target("--set", 4, _set_option))
    found.append(Target("YAML text", 6, _text(made)))
    found.append(Target("sensor.yaml", 5, _sensor(made.sensor)))
    found.append(Target("simulator, run", 0.4, _simulate))
    return found


def _read(folder: str, cls: type[Options]) -> Callable[[random.Random, Path], object]:
    files = [shipped_file(name, folder) for name in shipped_names(folder)]
    contents = [file.read_text(encoding="utf-8") for file in files]
    # All keys with their defaults, so that those that no file names are changed too.
    contents += [yaml.safe_dump(load_options(cls, file).to_mapping()) for file in files]
    trees = [yaml.safe_load(content) for content in contents]

    def attempt(generator: random.Random, place: Path) -> object:
        file = place / f"{folder}.yaml"
        tree = change_tree(generator.choice(trees), generator)
        file.write_bytes(yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass"))
        options = load_options(cls, file)
        require_equal(options.to_mapping(), stated(file.read_bytes()), folder)
        return options

    return attempt


def _set_option(generator: random.Random, place: Path) -> object:
    del place
    folder, cls = generator.choice(list(_CLASSES.items()))
    name = generator.choice(shipped_names(folder))
    tree: Any = resolve_options(cls, name).to_mapping()
    words = []
    while isinstance(tree, dict | list) and tree:
        key = generator.choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
        words.append(str(key))
        tree = tree[key]
    text = f"{'.'.join(words)}={generator.choice(HOSTILE)}"
    if generator.random() < 0.4:
        text = change_bytes(text.encode("utf-8", "replace"), generator).decode("utf-8", "replace")
    return resolve_options(cls, name, (text,))


def _text(made: tiny.Tiny) -> Callable[[random.Random, Path], object]:
    files = [shipped_file(n, f) for f in _CLASSES for n in shipped_names(f)]
    contents = [file.read_bytes() for file in (*files, made.run / "calibration.yaml")]

    def attempt(generator: random.Random, place: Path) -> object:
        del place
        content = change_bytes(generator.choice(contents), generator)
        text = content.decode("utf-8", "replace")
        found = parse_yaml(text, "text")
        require_equal(found, stated(text), "text")
        return found

    return attempt


def _sensor(source: Path) -> Callable[[random.Random, Path], object]:
    tree = yaml.safe_load(source.read_text(encoding="utf-8"))
    tree["camera"] |= {"width": 12, "height": 10}
    depth = torch.linspace(0.3, 3.0, 120).reshape(10, 12)
    light = torch.linspace(10.0, 6e4, 120).reshape(10, 12)

    def attempt(generator: random.Random, place: Path) -> object:
        file = place / "sensor.yaml"
        file.write_text(yaml.safe_dump(change_tree(tree, generator)), encoding="utf-8")
        sensor = tofcorr.SensorModel.load(file)
        require_equal(sensor.sensor.to_mapping(), stated(file.read_bytes()), "sensor.yaml")
        with torch.no_grad():
            return sensor(depth, light, generator=torch.Generator().manual_seed(1))

    return attempt


def _simulate(generator: random.Random, place: Path) -> object:
    tree = change_tree(tiny.simulator(1), generator)
    options = SimulatorOptions.from_mapping(tree if isinstance(tree, dict) else {}, "simulator")
    frames = sum(shot.poses for shot in options.shots)
    frames += options.robot.repeat_poses * options.robot.repeat_frames
    camera = options.camera
    if frames > _MOST_FRAMES or camera.width * camera.height > 1000:
        return options
    shutil.rmtree(place / "simulated", ignore_errors=True)
    return simulate(options, place / "simulated")
