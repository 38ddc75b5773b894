"""Targets: the binary files that tofcorr writes itself."""

import io
import json
import random
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import tofcorr
from benchmarks.fuzzing.mutations import HOSTILE, change_bytes, change_tree
from benchmarks.fuzzing.target import SilentlyDifferentError, Target
from benchmarks.tiny import Tiny
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.lookup import read_lut
from tofcorr.correction.metadata import load_corrector
from tofcorr.correction.state import CalibrationState, load_calibration

Output = tuple[Tensor, Tensor]


def targets(tiny: Tiny) -> list[Target]:
    """Return the targets: each file with changed bytes, changed records, and changed values."""
    state, module = tiny.run / "state.pt", tiny.module
    corrector = tiny.run / "corrector.ts"
    readers: dict[Path, Callable[[Path], Any]] = {
        state: lambda path: _used(load_calibration(path)),
        module: lambda path: _called(tofcorr.DepthCorrection.load(path)),
        corrector: lambda path: _called(load_corrector(path)[0]),
        tiny.lut: _called_lut,
    }
    found = []
    for path, read in readers.items():
        content, wanted = path.read_bytes(), read(path)
        share = 2.0 if path == corrector else 4.0
        same = _unchanged(path.name, content, read, wanted)
        found.append(Target(f"{path.name}, bytes", share, same(change_bytes)))
        found.append(Target(f"{path.name}, records", share, same(_change_record)))
    found += [
        Target(f"{path.name}, values", 6, _saved_again(path, readers[path]))
        for path in (state, module)
    ]
    found.append(Target("corrector.npz, values", 2, _lut_again(tiny.lut)))
    return found


def _frames() -> Output:
    depth = torch.linspace(0.3, 3.0, 120).reshape(10, 12)
    return depth, torch.linspace(10.0, 5e4, 120).reshape(10, 12).flip(0)


def _called(corrector: Any) -> list[Tensor]:  # noqa: ANN401 - a module or a scripted one
    with torch.no_grad():
        found = corrector(*_frames())
    return list(found) if isinstance(found, tuple) else [found]


def _used(state: CalibrationState) -> list[Tensor]:
    corrector = DepthCorrector.from_state(state)
    corrector.metadata()
    if (state.camera.height, state.camera.width) != (10, 12):
        return [corrector.radial_of_z]
    return [*_called(corrector), state.tool_from_camera]


def _called_lut(path: Path) -> list[Tensor]:
    table = read_lut(path)
    frames = [one.numpy() for one in _frames()]
    if table.offset.shape != frames[0].shape:
        return [torch.from_numpy(np.array(table.offset))]
    return [torch.from_numpy(np.array(one)) for one in table(*frames)]


Change = Callable[[bytes, random.Random], bytes]


def _unchanged(
    name: str, content: bytes, read: Callable[[Path], list[Tensor]], wanted: list[Tensor]
) -> Callable[[Change], Callable[[random.Random, Path], object]]:
    """Return attempts whose input must be refused, or give the same output."""

    def of(change: Change) -> Callable[[random.Random, Path], object]:
        def attempt(generator: random.Random, folder: Path) -> object:
            path = folder / name
            path.write_bytes(change(content, generator))
            found = read(path)
            for one, other in zip(found, wanted, strict=True):
                if not torch.equal(one.nan_to_num(-1.0), other.nan_to_num(-1.0)):
                    raise SilentlyDifferentError(f"{name}: another output than before")
            return found

        return attempt

    return of


def _change_record(content: bytes, generator: random.Random) -> bytes:
    """Change one record of the archive, with a checksum that fits."""
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(written, "w") as new:
        names = old.namelist()
        chosen = generator.choice(names)
        for name in names:
            record = old.read(name)
            if name == chosen:
                kind = generator.randrange(4)
                if kind == 0:
                    continue
                if kind == 1:
                    new.writestr(name + "x", record)
                    continue
                record = change_bytes(record, generator)
            new.writestr(name, record)
    return written.getvalue()


def _saved_again(
    source: Path, read: Callable[[Path], object]
) -> Callable[[random.Random, Path], object]:
    """Return attempts on a file that was loaded, changed and saved by torch: it has no seal."""
    values = torch.load(source, weights_only=True)

    def attempt(generator: random.Random, folder: Path) -> object:
        changed = _change_values(values, generator)
        path = folder / f"again-{source.name}"
        torch.save(changed, path)
        return read(path)

    return attempt


def _change_values(values: Any, generator: random.Random) -> Any:  # noqa: ANN401 - nested
    """Change one or two tensors or plain values."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if generator.random() < 0.5:
            return change_tree(values, generator)
        changed = dict(values)
        for _ in range(generator.choice((1, 1, 2))):
            holder = changed
            if isinstance(changed.get("state"), dict) and generator.random() < 0.8:
                holder = changed["state"] = dict(changed["state"])
            if not holder:
                break
            key = generator.choice(list(holder))
            if isinstance(holder[key], Tensor):
                holder[key] = _change_tensor(holder[key], generator)
            else:
                holder[key] = generator.choice(HOSTILE)
        return changed


def _change_tensor(values: Tensor, generator: random.Random) -> Any:  # noqa: ANN401 - any value
    values = values.to_dense()  # It may have been made sparse before.
    changes: list[Callable[[], Any]] = [
        lambda: values[..., :-1] if values.dim() else values.reshape(1),
        lambda: torch.cat([values, values]) if values.dim() else values.expand(2),
        lambda: values.reshape(1, *values.shape),
        lambda: torch.zeros(0, dtype=values.dtype),
        lambda: torch.full_like(values, generator.choice((0, 1, 77))),
        lambda: values.to(torch.float64) * generator.choice((1e30, 1e300, 0.0, -1.0, 1e-300)),
        lambda: values.to(torch.float64) + generator.choice((torch.nan, torch.inf)),
        lambda: values.to(generator.choice((torch.float32, torch.int64, torch.bool))),
        lambda: values.to(torch.complex128),
        lambda: values.to(torch.float32).to_sparse(),
        lambda: values.flatten()[torch.randperm(values.numel())].reshape(values.shape),
        values.tolist,
        lambda: generator.choice(HOSTILE),
    ]
    return generator.choice(changes)()


def _lut_again(source: Path) -> Callable[[random.Random, Path], object]:
    with np.load(source) as file:
        arrays = dict(file)

    def attempt(generator: random.Random, folder: Path) -> object:
        changed = dict(arrays)
        key = generator.choice(list(changed))
        if key == "metadata":
            tree = change_tree(json.loads(str(changed[key])), generator)
            changed[key] = np.array(json.dumps(tree, default=str))
        else:
            values = torch.from_numpy(changed[key])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                new = _change_tensor(values, generator)
            if isinstance(new, Tensor):
                new = new.to_dense().numpy()
            try:
                changed[key] = np.array(new)
            except ValueError:  # No array can be made of it.
                changed[key] = np.array(str(new))
            if changed[key].dtype.hasobject:
                changed[key] = np.array(str(new))
            mark = generator.random() < 0.3
            if mark:  # As a file of an older version, without a digest.
                changed["metadata"] = np.array(
                    str(changed["metadata"]).replace('"sha256"', '"was_sha256"')
                )
        path = folder / "again.npz"
        np.savez(path, **changed)
        return _called_lut(path)

    return attempt
