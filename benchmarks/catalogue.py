"""Does the diagnosis name effects that its own simulator can make? A check of algebra and power.

    python -m benchmarks.catalogue --seed 0 [--size-mm 6]

Every recording has poses, light, noise and the effect's own coefficients (drawn from their prior,
scaled to the size asked for) from its seed. The simulator under diagnosis is fitted to the
recording and has none of them. `benchmarks/withheld` asks the harder question, and what is named
where nothing is missing, with another generator.
"""

import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import click
import torch
from tqdm import tqdm

from benchmarks.sealed.remains import diagnosed
from benchmarks.sealed.scores import share, table
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import effect_inputs, observe
from tofcorr.diagnosis.sums.study import absorbed_share
from tofcorr.errors import CalibrationDataError
from tofcorr.options import resolve_options
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "simulate" / "diagnosis.yaml"
# Every effect but finer forms of the base model's own terms.
EFFECTS = tuple(name for name in CATALOGUE if name not in ("distance", "pixel"))
NEED_MOTION = ("motion", "timestamp_offset")
MOVING = {
    "robot": {"motion": "continuous", "repeat_poses": 0},
    "conditions": {"frame_interval_s": 0.3},
}


def simulator_options(seed: int, effect: str) -> SimulatorOptions:
    """Return the simulator of a case, without its effects."""
    values = resolve_options(SimulatorOptions, CONFIG).to_mapping()
    if effect in NEED_MOTION:
        values = {k: v | MOVING[k] if k in MOVING else v for k, v in values.items()}
    return SimulatorOptions.from_mapping(values | {"seed": seed}, str(CONFIG))


def drawn_effect(
    name: str, size_mm: float, inputs: EffectInputs, generator: torch.Generator
) -> dict[str, Any]:
    """Draw an effect's coefficients from their prior, scaled to a size, as a simulator's entry."""
    kind = CATALOGUE[name]
    effect = kind.for_recording(inputs)
    if isinstance(effect, MapEffect):
        seed = int(torch.randint(2**31, (), generator=generator))
        size = {"height": inputs.camera.height, "width": inputs.camera.width, "seed": seed}
        if name == "fixed_pattern":
            return {"name": name, "rms_m": size_mm * 1e-3} | size
        half = size_mm * 1e-3 / 2**0.5
        return {"name": name, "row_rms_m": half, "column_rms_m": half} | size
    prior = effect.prior_sd()
    direction = torch.randn(len(prior), generator=generator, dtype=torch.float64) * prior
    scale = 1.0
    for _ in range(30):
        shift = effect.shift(inputs, scale * direction)
        scale *= (size_mm * 1e-3 / float(shift.square().mean().sqrt())) ** 0.7
    return effect.with_coefficients(scale * direction).to_mapping()


def answer(seed: int, effect: str, size_mm: float) -> tuple[object, ...]:
    """Simulate and diagnose one effect; draw another if it leaves no pixel usable.

    Returns:
        Its name, whether it was named first and in a set of three at most, and a row's other cells.
    """
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _answer(Path(folder), seed, effect, size_mm)
    except CalibrationDataError:
        return answer(seed + 500_000, effect, size_mm)


def _answer(folder: Path, seed: int, effect: str, size_mm: float) -> tuple[object, ...]:
    plain = simulator_options(seed, effect)
    observed = observe(simulate(plain, folder / "quiet", noise=False), 100_000)
    inputs = effect_inputs(observed, plain.hand_eye.tool_from_camera())
    entry = drawn_effect(effect, size_mm, inputs, torch.Generator().manual_seed(seed))
    simulate(plain.model_copy(update={"effects": (entry,)}), folder / "recording")
    study, named, gap, left = diagnosed(folder / "recording", DiagnosisOptions())
    known = effect in study.effects
    return (
        effect,
        named.names[:1] == (effect,),
        any(effect in members and len(members) <= 3 for members in named.cause_sets),
        "; ".join(", ".join(members) for members in named.cause_sets),
        left.unknown,
        f"{1e3 * gap.before:.2f} to {1e3 * gap.after:.2f}",
        f"{100 * absorbed_share(study, effect):.0f} %" if known else "",
    )


HEAD = (
    *("effect", "named first", "in a set of at most 3", "sets named", "unknown", "gap, mm"),
    "absorbed by calibration",
)


@click.command()
@click.option("--seed", default=0, show_default=True)
@click.option("--size-mm", default=6.0, show_default=True, help="RMS of each effect.")
@click.option("--workers", default=2, show_default=True)
def main(seed: int, size_mm: float, workers: int) -> None:
    """Diagnose recordings of the project's own simulator, one with each effect."""
    seeds = range(1_000_000 * (seed + 1) + 1000, 1_000_000 * (seed + 2))
    with ProcessPoolExecutor(workers) as pool:
        found = pool.map(partial(answer, size_mm=size_mm), seeds, EFFECTS)
        rows = list(tqdm(found, "effects", len(EFFECTS), leave=False))
    sums = [share(bool(row[place]) for row in rows) for place in (1, 2)]
    click.echo(table(HEAD, [*rows, ("all", *sums, "", "", "", "")]))


if __name__ == "__main__":
    main()
