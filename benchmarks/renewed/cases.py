"""Recordings for the program under test and, apart, what is true of them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed.forms import INSIDE, OUTSIDE
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.form import Form
from benchmarks.renewed.generator.measure import noise_of
from benchmarks.renewed.generator.recording import Recorded, Truth, record
from benchmarks.renewed.generator.strength import scaled
from benchmarks.renewed.generator.world import World, draw_world
from benchmarks.renewed.generator.writing import write_recording
from benchmarks.withheld.sealing import seal

TIERS = ("E", "N", "O")  # an effect, nothing, an effect outside any catalogue


def generate(seed: int, counts: Mapping[str, int], out: Path) -> Iterator[str]:
    """Write `out/recordings`, `out/answers` and, last, `out/manifest.json`; yield each name.

    Raises:
        FileExistsError: The folder holds cases already.
    """
    out.mkdir(parents=True, exist_ok=True)
    if (out / "manifest.json").exists():
        raise FileExistsError(f"{out} already holds cases; choose another folder")
    entries = []
    for tier, count in counts.items():
        for index in range(count):
            entries.append(write_case(seed, tier, index, out))
            yield entries[-1]["id"]
    write_manifest(out, entries, np.random.default_rng([seed, 99]))


def write_manifest(out: Path, entries: list[dict[str, Any]], rng: np.random.Generator) -> None:
    """Write the manifest, or add entries to it: recordings in random order."""
    file = out / "manifest.json"
    empty = {"format": "tofcorr-renewed", "version": 1, "recordings": []}
    manifest = json.loads(file.read_text()) if file.exists() else empty
    manifest["recordings"] += [entries[i] for i in rng.permutation(len(entries))]
    file.write_text(json.dumps(manifest, indent=1))


def write_case(seed: int, tier: str, index: int, out: Path) -> dict[str, Any]:
    """Write one case; return the manifest's entry. It depends on seed, tier and index alone."""
    rng = np.random.default_rng([seed, TIERS.index(tier), index])
    form = form_of(seed, tier, index)
    world = draw_world(rng, form.wanted if form else None)
    hooks = []
    if form is not None:
        size = ranges.SIZES_MM.draw(rng) * 1e-3
        hooks = [scaled(world, form, form.draw(rng, world), size)]
    recorded, truth = record(rng, world, hooks)
    name = f"r{rng.integers(2**48):012x}"
    write_recording(out / "recordings" / name, recorded)
    answer = {
        "role": "main",
        "index": index,
        "id": name,
        "case": described(tier, form, world),
        "sizes_mm": _sizes(recorded, truth),
        "strengths": {hook.form.effect: hook.strength for hook in hooks},
        "salt": rng.bytes(16).hex(),  # so that the hash cannot be guessed from a list of answers
    }
    arrays = {f"field_{effect}": field.astype(np.float32) for effect, field in truth.fields.items()}
    arrays["expected"] = truth.expected.astype(np.float32)
    arrays["noise"] = noise_of(world, hooks).astype(np.float32)
    return {
        "id": name,
        "exclude": [],
        "answer_sha256": seal(out / "answers" / name, answer, arrays),
    }


def form_of(seed: int, tier: str, index: int) -> Form | None:
    """The form whose turn it is: every one once in each round, in an order of the round's own.

    The order depends on the seed, so that a run of few cases is a sample of all forms.
    """
    if tier == "N":
        return None
    forms = INSIDE if tier == "E" else OUTSIDE
    order = np.random.default_rng([seed, index // len(forms)]).permutation(len(forms))
    return forms[order[index % len(forms)]]


def described(tier: str, form: Form | None, world: World) -> dict[str, Any]:
    """What the answer says of a case, apart from its sizes."""
    sensor = world.sensor
    return {
        "tier": tier,
        "effect": form.effect if form else None,
        "form": form.name if form else None,
        "textbook": form.textbook if form else None,
        "design": asdict(world.design) | {"poses": int(world.way.pose_id[-1]) + 1},
        "sensor": {
            "width": sensor.lens.width,
            "height": sensor.lens.height,
            "frequencies": sensor.frequencies,
            "sun": sensor.sun > 0,
            "tail": None if np.isinf(sensor.tail) else sensor.tail,
            "spatial_filter": sensor.spatial_filter,
            "temporal_filter": sensor.temporal_filter,
            "rounding_mm": 1e3 * sensor.rounding,
        },
    }


def _sizes(recorded: Recorded, truth: Truth) -> dict[str, float]:
    return truth.sizes_mm(recorded.mask & np.isfinite(recorded.depth))
