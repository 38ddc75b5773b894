"""Tier K: real images of a Kinect v2, with an effect added to the depth or a term withheld.

The images come from `$TOFCORR_REAL_DATA` through `tofcorr import checkerboard`; every third pixel
of every third row is kept. An effect is added by the generator's own physics at the depth and
amplitude that the camera gave. A term is withheld by a configuration whose base model lacks it.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from benchmarks.withheld.generator.camera import SPEED_OF_LIGHT
from benchmarks.withheld.generator.catalogue import draw_effect
from benchmarks.withheld.generator.effect import Applied
from benchmarks.withheld.generator.observe import View, demodulate, taps_of
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.generator.strength import scale_to
from benchmarks.withheld.generator.tiers import Case
from benchmarks.withheld.reading import Data, read
from benchmarks.withheld.sealing import seal

STRIDE = 3
MODULATION = 80e6  # Hz, the middle one of the camera's three
ADDED = ("wiggling", "incidence_angle", "saturation", "row_column_pattern", "fixed_pattern")
SIZES_MM = (3.0, 6.0)
BASE = {
    "distance": {"kind": "distance_polynomial", "degree": 3},
    "pixel": {"kind": "pixel_polynomial", "degree": 2},
    "amplitude": {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
}
KINECT = {
    "width": 512,
    "height": 424,
    "K": [[365.5, 0.0, 255.5], [0.0, 365.5, 205.0], [0.0, 0.0, 1.0]],
    "distortion": [0.0905, -0.268, 0.0, 0.0, 0.095],
}


def generate_real(seed: int, out: Path) -> Iterator[str]:
    """Add tier K to `out` and its manifest; yield each recording's name.

    Raises:
        KeyError: when `$TOFCORR_REAL_DATA` is not set.
    """
    full = import_kinect(Path(os.environ["TOFCORR_REAL_DATA"]), out)
    thin = thinned(full, out / "kinect")
    rng = np.random.default_rng([seed, 10])
    data = read(thin)
    entries = [_write(out, thin, data, rng, "plain")]
    yield entries[-1]["id"]
    for term in BASE:
        kept = [one for name, one in BASE.items() if name != term]
        entries.append(_write(out, thin, data, rng, "term", term=term))
        entries[-1]["config"] = yaml.safe_dump({"base": {"terms": kept}})
        yield entries[-1]["id"]
    for name in ADDED:
        for size in SIZES_MM:
            entries.append(_write(out, thin, data, rng, "added", effect=(name, size)))
            yield entries[-1]["id"]
    _extend_manifest(out, entries, rng)


def import_kinect(folder: Path, out: Path) -> Path:
    """Import the images with the installed program; return the recording."""
    recording, intrinsics = out / "kinect_full", out / "kinect.json"
    if recording.exists():
        return recording
    out.mkdir(parents=True, exist_ok=True)
    intrinsics.write_text(json.dumps(KINECT))
    command = [str(Path(sys.executable).with_name("tofcorr")), "import", "checkerboard"]
    command += [str(folder / "kinect2_checkerboard"), "--out", str(recording)]
    command += ["--depth", "{view}_sync_depth.png", "--infrared", "{view}_sync_ir.png"]
    command += ["--board", "5x7", "--square-mm", "30", "--intrinsics", str(intrinsics)]
    command += ["--modulation-frequency-hz", str(MODULATION)]
    subprocess.run(command, check=True, capture_output=True)
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
    """A view that looks as the camera says; pixels without return or off target are dark."""
    direction = np.einsum("nj,hwj->nhw", data.normal, data.rays)
    distance = np.where(data.valid, data.depth, 1.0)
    amplitude = data.amplitude if data.amplitude is not None else np.ones_like(distance)
    cosine = np.clip(np.abs(direction), 0.05, 1.0)
    white = amplitude * distance**2 / cosine
    full = SPEED_OF_LIGHT / (2 * MODULATION)
    dark = np.zeros(len(distance))
    world: Any = SimpleNamespace(
        frames=len(distance),
        camera=SimpleNamespace(
            unambiguous_range=full,
            sensitivity=float(np.quantile(white[data.valid], 0.1)),
            height=distance.shape[1],
            width=distance.shape[2],
        ),
        conditions=SimpleNamespace(ambient=dark, exposure=dark),
    )
    amplitude = np.where(data.valid, np.maximum(amplitude, 1.0), 0.0)
    return View(
        world=world,
        distance=distance,
        cosine=cosine,
        reflectivity=np.zeros_like(distance),
        amplitude=np.maximum(amplitude, 1e-9),
        on_target=data.valid,
        path=distance,
        phasor=amplitude * np.exp(2j * np.pi * distance / full),
    )


def _amplitude_change(view: View, applied: Applied) -> Array:
    """Factor (N, H, W) by which the effect changes the amplitude."""
    if applied.effect.stage != "taps":
        return np.ones_like(view.distance)
    full = view.world.camera.unambiguous_range
    after = demodulate(taps_of(view, [applied]), full)[1]
    return np.where(view.on_target, after / view.amplitude, 1.0)


def _write(
    out: Path,
    thin: Path,
    data: Data,
    rng: np.random.Generator,
    role: str,
    term: str = "",
    effect: tuple[str, float] | None = None,
) -> dict[str, Any]:
    """Write one recording of the tier and its sealed answer; return the manifest's entry."""
    name = f"r{rng.integers(2**48):012x}"
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    for file in ("frames.csv", "recording.yaml", "mask.npy"):
        (folder / file).write_bytes((thin / file).read_bytes())
    depth, amplitude = np.load(thin / "depth.npy"), np.load(thin / "amplitude.npy")
    sizes, arrays = {term: 0.0} if term else {}, {}
    if effect is not None:
        view = real_view(data)
        applied, field = scale_to(view, draw_effect(effect[0], rng), effect[1] * 1e-3)
        field = np.where(data.valid, field, 0.0)
        sizes[effect[0]] = 1e3 * float(np.sqrt(np.mean(field[data.valid] ** 2)))
        arrays[f"field_{effect[0]}"] = field.astype(np.float32)
        depth = np.where(data.valid, depth + field * data.depth_per_range, depth)
        amplitude = amplitude * _amplitude_change(view, applied)
    np.save(folder / "depth.npy", depth.astype(np.float32))
    np.save(folder / "amplitude.npy", amplitude.astype(np.float32))
    answer = {
        "role": role,
        "index": 0,
        "id": name,
        "case": asdict(Case("K")) | {"withhold": []},
        "sizes_mm": sizes,
        "salt": rng.bytes(16).hex(),
    }
    commitment = seal(out / "answers" / name, answer, arrays)
    return {"id": name, "exclude": [], "answer_sha256": commitment}


def _extend_manifest(out: Path, entries: list[dict[str, Any]], rng: np.random.Generator) -> None:
    file = out / "manifest.json"
    empty = {"format": "tofcorr-withheld", "version": 1, "recordings": []}
    manifest = json.loads(file.read_text()) if file.exists() else empty
    manifest["recordings"] += [entries[i] for i in rng.permutation(len(entries))]
    file.write_text(json.dumps(manifest, indent=1))
