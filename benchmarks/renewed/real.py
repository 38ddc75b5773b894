"""Tier K: real images of a Kinect v2, with a form of an effect added, or a base term withheld.

The images come from `$TOFCORR_REAL_DATA` through `tofcorr import checkerboard`; every third pixel
of every third row is kept. A form is applied to the phasor or the samples that belong to the depth
and amplitude that the camera gave. A term is withheld by a configuration whose base model lacks it.
The diagnosis refuses images of one pixel, so the real arm's trials take no part yet.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from benchmarks.renewed import ranges
from benchmarks.renewed.forms import FORM
from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, Random, image_grid
from benchmarks.renewed.recording import Data, read
from benchmarks.renewed.signal_chain import (
    Form,
    Hook,
    View,
    changed,
    demodulate,
    samples,
    strength_for,
)
from benchmarks.renewed.world import NOMINAL_US
from benchmarks.sealed.answers import Entry, seal

FORMS = (  # those that need no more than a pixel's own depth, amplitude and place in the image
    *("odd_harmonics", "duty_cycle", "phase_table", "soft_knee", "gain_switch"),
    *("every_pixel", "hot_pixels", "blocks", "free_columns", "halves_and_pairs", "clock_beat"),
    *("ghost", "veil", "clear_layer", "rendered_slab", "grazing"),
)
BASE = {  # terms of the base model, of which one is withheld at a time
    "distance": {"kind": "distance_polynomial", "degree": 3},
    "pixel": {"kind": "pixel_polynomial", "degree": 2},
    "amplitude": {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
}
STRIDE = 3
MODULATION = 80e6  # Hz, the middle one of the camera's three


def write_real(seed: int, out: Path, forms: Sequence[str] = FORMS) -> Iterator[Entry]:
    """Write the images as they are, with each form at a size that is drawn, without each term.

    Raises:
        KeyError: when `$TOFCORR_REAL_DATA` is not set.
    """
    thin = thinned(import_kinect(Path(os.environ["TOFCORR_REAL_DATA"]), out), out / "kinect")
    rng, data = np.random.default_rng([seed, 10]), read(thin)
    view = real_view(data)
    yield _write(rng, out, thin, data)
    for name in forms:
        yield _write(rng, out, thin, data, added=_added(rng, view, FORM[name]))
    for term in BASE:
        kept = [one for name, one in BASE.items() if name != term]
        entry = _write(rng, out, thin, data, term=term)
        yield entry | {"config": yaml.safe_dump({"base": {"terms": kept}})}


def import_kinect(folder: Path, out: Path) -> Path:
    """Import the images with the installed program; return the recording."""
    recording = out / "kinect_full"
    if not recording.exists():
        out.mkdir(parents=True, exist_ok=True)
        program = str(Path(sys.executable).with_name("tofcorr"))
        words = [program, "import", "checkerboard", str(folder / "kinect2_checkerboard")]
        words += ["--depth", "{view}_sync_depth.png", "--infrared", "{view}_sync_ir.png"]
        words += ["--board", "5x7", "--square-mm", "30", "--intrinsics", "kinect2"]
        words += ["--modulation-frequency-hz", str(MODULATION), "--out", str(recording)]
        subprocess.run(words, check=True, capture_output=True)
    return recording


def thinned(recording: Path, out: Path) -> Path:
    """Write every third pixel of every third row as a recording of its own."""
    if out.exists():
        return out
    out.mkdir()
    about = yaml.safe_load((recording / "recording.yaml").read_text())
    for name in ("depth", "amplitude", "mask"):
        np.save(out / f"{name}.npy", np.load(recording / f"{name}.npy")[:, ::STRIDE, ::STRIDE])
    camera = about["camera"]
    camera["height"], camera["width"] = np.load(out / "depth.npy", mmap_mode="r").shape[1:]
    camera["K"] = (np.diag([1 / STRIDE, 1 / STRIDE, 1.0]) @ camera["K"]).tolist()
    (out / "recording.yaml").write_text(yaml.safe_dump(about))
    (out / "frames.csv").write_bytes((recording / "frames.csv").read_bytes())
    return out


def real_view(data: Data) -> View:
    """A view that looks as the camera says, off the target too; without return it is dark."""
    cosine = np.abs(np.einsum("nj,hwj->nhw", data.normal, data.rays))
    seen = np.isfinite(data.depth) & (data.depth > 0)
    distance = np.where(seen, data.depth, 1.0)
    amplitude = np.ones_like(distance) if data.amplitude is None else data.amplitude
    count, height, width = distance.shape
    lens = SimpleNamespace(width=width, height=height)
    world: Any = SimpleNamespace(
        frames=count,
        sensor=SimpleNamespace(lens=lens, frequencies=(MODULATION,), sun=0.0),
        conditions=SimpleNamespace(ambient=np.zeros(count), exposure=np.full(count, NOMINAL_US)),
        pixel_position=image_grid(height, width),
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


Added = tuple[Form, Array, Array]
"""A form with its change of depth (N, H, W), metres, and its factor of the amplitude."""


def _added(rng: Random, view: View, form: Form) -> Added:
    change = form.draw(rng, view.world)
    before = _measured(view, [])

    def field(strength: float) -> Array:
        full = SPEED_OF_LIGHT / (2 * MODULATION)
        difference = _measured(view, [Hook(form, change, strength)])[0] - before[0]
        return np.where(view.on_target, (difference + full / 2) % full - full / 2, 0.0)

    def size_at(strength: float) -> float:
        return float(np.sqrt(np.mean(field(strength)[view.on_target] ** 2)))

    size = 1e-3 * ranges.draw("sizes_mm", rng)
    hook = Hook(form, change, strength_for(size_at, form.guess, size))
    factor = _measured(view, [hook])[1] / np.maximum(before[1], 1e-12)
    return form, field(hook.strength), np.where(view.on_target, factor, 1.0)


def _measured(view: View, hooks: list[Hook]) -> tuple[Array, Array]:
    moved = replace(view, path=changed("path", hooks, view, view.path))
    phase, amplitude = demodulate(samples(moved, hooks))
    return phase / (2 * np.pi) * SPEED_OF_LIGHT / (2 * MODULATION), amplitude


def _write(
    rng: Random, out: Path, thin: Path, data: Data, *, term: str = "", added: Added | None = None
) -> Entry:
    """Write one recording of the tier and its sealed answer; return the manifest's entry."""
    name = f"r{rng.integers(2**48):012x}"
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    for file in ("frames.csv", "recording.yaml", "mask.npy"):
        (folder / file).write_bytes((thin / file).read_bytes())
    depth, amplitude = np.load(thin / "depth.npy"), np.load(thin / "amplitude.npy")
    case: dict[str, Any] = {"tier": "K", "design": {"frames": len(depth)}}
    sizes, arrays = {term: 0.0} if term else {}, {}
    if added is not None:
        form, field, factor = added
        case |= {"effect": form.effect, "form": form.name, "textbook": form.textbook}
        sizes[form.effect] = 1e3 * float(np.sqrt(np.mean(field[data.valid] ** 2)))
        arrays[f"field_{form.effect}"] = field
        depth = np.where(data.valid, depth + field * data.depth_per_range, depth)
        amplitude = amplitude * factor
    np.save(folder / "depth.npy", depth.astype(np.float32))
    np.save(folder / "amplitude.npy", amplitude.astype(np.float32))
    role = "added" if added else "term" if term else "plain"
    answer = {"role": role, "index": 0, "id": name, "case": case, "sizes_mm": sizes}
    return {"id": name, "exclude": [], "answer_sha256": seal(rng, out, answer, arrays)}
