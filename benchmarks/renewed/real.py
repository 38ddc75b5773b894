"""Tier K: real images of a Kinect v2 with a form of an effect added to them.

The images are those of `benchmarks.withheld.real`: every third pixel of every third row. A form is
applied to the phasor or the samples that belong to the depth and amplitude that the camera gave.
The diagnosis refuses images of one pixel, so the real arm's trials take no part yet.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.renewed.cases import write_manifest
from benchmarks.renewed.forms import INSIDE
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.conditions import NOMINAL_US
from benchmarks.renewed.generator.form import Form, Hook
from benchmarks.renewed.generator.measure import demodulate, samples
from benchmarks.renewed.generator.strength import strength_for
from benchmarks.renewed.generator.view import View, changed
from benchmarks.withheld.generator.camera import SPEED_OF_LIGHT
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.reading import Data, read
from benchmarks.withheld.real import MODULATION, import_kinect, thinned
from benchmarks.withheld.sealing import seal

ADDED = (  # those that need no more than a pixel's own depth, amplitude and place in the image
    *("odd_harmonics", "duty_cycle", "phase_table"),
    *("clear_layer", "rendered_slab", "grazing"),
    *("soft_knee", "gain_switch", "every_pixel", "hot_pixels", "blocks"),
    *("free_columns", "halves_and_pairs", "clock_beat", "ghost", "veil"),
)


def generate_real(seed: int, out: Path) -> Iterator[str]:
    """Add tier K to `out` and its manifest; yield each recording's name.

    Raises:
        KeyError: when `$TOFCORR_REAL_DATA` is not set.
    """
    full = import_kinect(Path(os.environ["TOFCORR_REAL_DATA"]), out)
    thin = thinned(full, out / "kinect")
    rng = np.random.default_rng([seed, 10])
    data = read(thin)
    view = real_view(data)
    entries = [_write(out, thin, data, rng, None)]
    yield entries[-1]["id"]
    for form in (form for form in INSIDE if form.name in ADDED):
        hook, depth, amplitude = _added(rng, view, form)
        entries.append(_write(out, thin, data, rng, (hook, depth, amplitude)))
        yield entries[-1]["id"]
    write_manifest(out, entries, rng)


def real_view(data: Data) -> View:
    """A view that looks as the camera says, off the target too; without return it is dark."""
    cosine = np.abs(np.einsum("nj,hwj->nhw", data.normal, data.rays))
    seen = np.isfinite(data.depth) & (data.depth > 0)
    distance = np.where(seen, data.depth, 1.0)
    amplitude = np.ones_like(distance) if data.amplitude is None else data.amplitude
    count, height, width = distance.shape
    column, row = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    still = SimpleNamespace(ambient=np.zeros(count), exposure=np.full(count, NOMINAL_US))
    lens = SimpleNamespace(width=width, height=height)
    world: Any = SimpleNamespace(
        frames=count,
        sensor=SimpleNamespace(lens=lens, frequencies=(MODULATION,), sun=0.0),
        conditions=still,
        pixel_position=(column, row),
    )
    return View(
        world=world,
        distance=distance,
        cosine=np.clip(cosine, 0.05, 1.0),
        on_target=data.valid,
        reflectivity=np.ones_like(distance),
        amplitude=np.where(seen, np.maximum(amplitude, 1.0), 1e-9),
        path=distance,
        frequency=MODULATION,
        bright=float(np.quantile(amplitude[data.valid], 0.98)),
    )


def _added(rng: np.random.Generator, view: View, form: Form) -> tuple[Hook, Array, Array]:
    """A form at a size of the ranges: change of depth (N, H, W) and factor of the amplitude."""
    change = form.draw(rng, view.world)
    before = _measured(view, [])

    def field(strength: float) -> Array:
        full = SPEED_OF_LIGHT / (2 * MODULATION)
        difference = _measured(view, [Hook(form, change, strength)])[0] - before[0]
        return np.where(view.on_target, (difference + full / 2) % full - full / 2, 0.0)

    def size_at(strength: float) -> float:
        return float(np.sqrt(np.mean(field(strength)[view.on_target] ** 2)))

    hook = Hook(form, change, strength_for(size_at, form.guess, ranges.SIZES_MM.draw(rng) * 1e-3))
    factor = _measured(view, [hook])[1] / np.maximum(before[1], 1e-12)
    return hook, field(hook.strength), np.where(view.on_target, factor, 1.0)


def _measured(view: View, hooks: list[Hook]) -> tuple[Array, Array]:
    moved = replace(view, path=changed("path", hooks, view, view.path))
    phase, amplitude = demodulate(samples(moved, hooks))
    return phase / (2 * np.pi) * SPEED_OF_LIGHT / (2 * MODULATION), amplitude


def _write(
    out: Path,
    thin: Path,
    data: Data,
    rng: np.random.Generator,
    added: tuple[Hook, Array, Array] | None,
) -> dict[str, Any]:
    """Write one recording of the tier and its sealed answer; return the manifest's entry."""
    name = f"r{rng.integers(2**48):012x}"
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    for file in ("frames.csv", "recording.yaml", "mask.npy"):
        (folder / file).write_bytes((thin / file).read_bytes())
    depth, amplitude = np.load(thin / "depth.npy"), np.load(thin / "amplitude.npy")
    case: dict[str, Any] = {"tier": "K", "source": "kinect", "design": {"frames": len(depth)}}
    sizes, arrays = {}, {}
    if added is not None:
        hook, field, factor = added
        case |= {"effect": hook.form.effect, "form": hook.form.name, "textbook": hook.form.textbook}
        sizes[hook.form.effect] = 1e3 * float(np.sqrt(np.mean(field[data.valid] ** 2)))
        arrays[f"field_{hook.form.effect}"] = field.astype(np.float32)
        depth = np.where(data.valid, depth + field * data.depth_per_range, depth)
        amplitude = amplitude * factor
    np.save(folder / "depth.npy", depth.astype(np.float32))
    np.save(folder / "amplitude.npy", amplitude.astype(np.float32))
    answer = {
        "role": "added" if added else "plain",
        "index": 0,
        "id": name,
        "case": case,
        "sizes_mm": sizes,
        "salt": rng.bytes(16).hex(),
    }
    commitment = seal(out / "answers" / name, answer, arrays)
    return {"id": name, "exclude": [], "answer_sha256": commitment}
