"""Pairs of recordings for the program under test and, apart, what is true of them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld.generator.pair_cases import KINDS, PairCase, draw_pair
from benchmarks.withheld.generator.pairs import Pair, record_pair
from benchmarks.withheld.generator.writing import OPTIONAL_COLUMNS, write_recording
from benchmarks.withheld.pairs.renderer import rendered
from benchmarks.withheld.sealing import seal

# What a simulator that knows geometry alone cannot write; frames of one pose have one number still.
UNKNOWN_TO_IDEAL = frozenset(OPTIONAL_COLUMNS) - {"pose_id"} | {
    "amplitude.npy",
    "modulation_frequency_hz",
}


def generate(seed: int, counts: Mapping[str, int], out: Path) -> Iterator[str]:
    """Write `out/recordings`, `out/answers` and, last, `out/manifest.json`; yield each name.

    An entry of the manifest names the camera's recording (`id`), the simulator's (`sim`) and, in
    some, ideal frames to be degraded (`held_out`).
    """
    out.mkdir(parents=True, exist_ok=True)
    if (out / "manifest.json").exists():
        raise FileExistsError(f"{out} already holds cases; choose another folder")
    entries = []
    for kind, count in counts.items():
        for index in range(count):
            entries.append(write_pair(seed, kind, index, out))
            yield entries[-1]["id"]
    order = np.random.default_rng([seed, 98]).permutation(len(entries))
    manifest = {
        "format": "tofcorr-withheld",
        "version": 1,
        "recordings": [entries[i] for i in order],
    }
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1))


def write_pair(seed: int, kind: str, index: int, out: Path) -> dict[str, Any]:
    """Write one pair; return the manifest's entry."""
    rng = np.random.default_rng([seed, 1000 + sorted(KINDS).index(kind), index])
    case = draw_pair(kind, index, rng)
    pair = record_pair(rng, case)
    if case.renderer:
        pair = replace(pair, simulated=rendered(pair.simulated))
    names = {part: f"r{rng.integers(2**48):012x}" for part in ("id", "sim", "held_out")}
    write_recording(out / "recordings" / names["id"], pair.real)
    unknown = UNKNOWN_TO_IDEAL if case.ideal else frozenset[str]()
    write_recording(out / "recordings" / names["sim"], pair.simulated, unknown)
    if pair.held_out is None:
        del names["held_out"]
    else:
        write_recording(out / "recordings" / names["held_out"], pair.held_out.ideal)
    commitment = _seal(out, names["id"], case, pair, {"index": index, "salt": rng.bytes(16).hex()})
    return {**names, "exclude": [], "answer_sha256": commitment}


def _seal(out: Path, name: str, case: PairCase, pair: Pair, about: Mapping[str, Any]) -> str:
    sizes = {
        effect: 1e3 * float(np.sqrt(np.mean(field[pair.real.mask] ** 2)))
        for effect, field in pair.fields.items()
    }
    answer = {
        **about,
        "role": "main",
        "id": name,
        "case": asdict(case),
        "sizes_mm": sizes,
        "truth": dict(pair.truth),
    }
    arrays = {f"field_{effect}": field.astype(np.float32) for effect, field in pair.fields.items()}
    arrays |= {"expected": pair.expected.astype(np.float32)}
    if pair.held_out is not None:
        arrays |= {
            "sigma": pair.sigma.astype(np.float32),
            "held_out": pair.held_out.expected.astype(np.float32),
            "held_out_sigma": pair.held_out.sigma.astype(np.float32),
        }
        arrays |= {
            f"held_out_field_{effect}": field.astype(np.float32)
            for effect, field in pair.held_out.fields.items()
        }
    return seal(out / "answers" / name, answer, arrays)
