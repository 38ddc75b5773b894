"""Recordings for the program under test and, apart, what is true of them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld.generator.catalogue import draw_effect
from benchmarks.withheld.generator.noise import NOISES
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.recording import Recorded, Truth, record, record_again
from benchmarks.withheld.generator.tiers import TIERS, Case, draw_case
from benchmarks.withheld.generator.world import draw_setup, draw_world
from benchmarks.withheld.generator.writing import write_recording
from benchmarks.withheld.sealing import seal

FRESH_FRAMES = 120


def generate(seed: int, counts: Mapping[str, int], out: Path) -> Iterator[str]:
    """Write `out/recordings`, `out/answers` and, last, `out/manifest.json`; yield each name.

    The manifest names recordings in random order, tells which effects the catalogue must do
    without, and the hash of each answer; tier and truth stay in the answers.
    """
    out.mkdir(parents=True, exist_ok=True)
    if (out / "manifest.json").exists():
        raise FileExistsError(f"{out} already holds cases; choose another folder")
    entries = []
    for tier, count in counts.items():
        for index in range(count):
            for entry in write_case(seed, tier, index, out):
                entries.append(entry)
                yield entry["id"]
    order = np.random.default_rng([seed, 99]).permutation(len(entries))
    manifest = {
        "format": "tofcorr-withheld",
        "version": 1,
        "recordings": [entries[i] for i in order],
    }
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1))


def write_case(seed: int, tier: str, index: int, out: Path) -> list[dict[str, Any]]:
    """Write one case, with its partner if it has one; return the manifest's entries."""
    rng = np.random.default_rng([seed, sorted(TIERS).index(tier), index])
    case = draw_case(tier, index, rng)
    setup = draw_setup(rng, case.wrong_base)
    wanted = [(draw_effect(name, rng), size * 1e-3) for name, size in case.effects]
    recorded, truth = record(rng, draw_world(rng, setup, case.design), wanted, NOISES[case.noise])
    main = f"r{rng.integers(2**48):012x}"
    entries = [_write(out, main, case, recorded, truth, {"role": "main", "index": index}, rng)]
    if case.partner:
        design = _partner_design(case)
        again = record_again(rng, draw_world(rng, setup, design), truth.applied, NOISES[case.noise])
        about = {"role": case.partner, "index": index, "main": main}
        entries.append(
            _write(
                out,
                f"r{rng.integers(2**48):012x}",
                replace(case, design=design),
                *again,
                about,
                rng,
            )
        )
    return entries


def _partner_design(case: Case) -> Design:
    if case.partner == "fresh":
        return replace(case.design, frames=FRESH_FRAMES, repeats=2 * case.design.repeats)
    return Design(repeats=case.design.repeats)


def _write(
    out: Path,
    name: str,
    case: Case,
    recorded: Recorded,
    truth: Truth,
    about: Mapping[str, Any],
    rng: np.random.Generator,
) -> dict[str, Any]:
    write_recording(out / "recordings" / name, recorded, case.withhold)
    answer = {
        **about,
        "id": name,
        "case": asdict(case) | {"withhold": sorted(case.withhold)},
        "sizes_mm": truth.sizes_mm,
        "strengths": {one.effect.name: one.strength for one in truth.applied},
        "tool_from_camera": recorded.world.setup.tool_from_camera.tolist(),
        "salt": rng.bytes(16).hex(),  # so that the hash cannot be guessed from a list of answers
    }
    arrays = {f"field_{effect}": field.astype(np.float32) for effect, field in truth.fields.items()}
    arrays["expected"] = truth.expected.astype(np.float32)
    commitment = seal(out / "answers" / name, answer, arrays)
    return {"id": name, "exclude": list(case.exclude), "answer_sha256": commitment}
