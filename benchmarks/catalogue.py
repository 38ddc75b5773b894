"""Does the diagnosis name effects that its own simulator can make? A check of algebra and power.

    python -m benchmarks.catalogue --seed 0 [--what single|nothing ...]

Every recording has poses, light, noise and the effect's own coefficients (drawn from their prior,
scaled to the size asked for) from its seed. The simulator under diagnosis is fitted to the
recording and has none of them. `benchmarks/withheld` asks the harder question, with another
generator.
"""

import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import click
import torch
from tqdm import tqdm

from benchmarks.sealed.remains import diagnosed
from benchmarks.sealed.scores import share
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import effect_inputs, observe
from tofcorr.errors import CalibrationDataError
from tofcorr.options import load_options
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs
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


class Case(NamedTuple):
    """A recording to be made and diagnosed: a seed, and the name and size of an effect, mm RMS."""

    seed: int
    effect: str = ""
    size_mm: float = 0.0


class Answer(NamedTuple):
    """What was said of a case; gaps in millimetres, and the share that calibration absorbs."""

    case: Case
    named: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    unknown: bool
    absorbed: float | None
    before: float
    after: float

    @property
    def covered(self) -> bool:
        """Whether the effect stands in a set of three at most."""
        return any(self.case.effect in one and len(one) <= 3 for one in self.sets)


def simulator_options(case: Case) -> SimulatorOptions:
    """Return the simulator of a case, without its effects."""
    values = load_options(SimulatorOptions, CONFIG).to_mapping()
    if case.effect in NEED_MOTION:
        values = {k: v | MOVING[k] if k in MOVING else v for k, v in values.items()}
    return SimulatorOptions.from_mapping(values | {"seed": case.seed}, str(CONFIG))


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


def answer(case: Case) -> Answer:
    """Simulate and diagnose one case; draw another if its effect leaves no pixel usable."""
    try:
        return _answer(case)
    except CalibrationDataError:
        return _answer(case._replace(seed=case.seed + 500_000))


def _answer(case: Case) -> Answer:
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(case.seed)
    plain = simulator_options(case)
    with tempfile.TemporaryDirectory() as folder:
        quiet, path = Path(folder) / "quiet", Path(folder) / "recording"
        entries = []
        if case.effect:
            simulate(plain, quiet, noise=False)
            observed = observe(Recording.open(quiet), 100_000)
            inputs = effect_inputs(observed, plain.hand_eye.tool_from_camera())
            entries = [drawn_effect(case.effect, case.size_mm, inputs, generator)]
        simulate(plain.model_copy(update={"effects": tuple(entries)}), path)
        study, named, gap, left = diagnosed(path, DiagnosisOptions())
    known = case.effect in study.candidates.effects
    return Answer(
        case=case,
        named=named.names,
        sets=named.cause_sets,
        unknown=left.unknown,
        absorbed=absorbed_share(study, case.effect) if known else None,
        before=1e3 * gap.before,
        after=1e3 * gap.after,
    )


def told(kind: str, answers: list[Answer]) -> str:
    """Return the findings of one question in a line."""
    unknown = sum(one.unknown for one in answers)
    if kind == "nothing":
        return f"an effect named: {share(bool(one.named) for one in answers)}; unknown: {unknown}"
    first = sum(one.named[:1] == (one.case.effect,) for one in answers)
    covered = sum(one.covered for one in answers)
    return f"in a set of at most 3: {covered} of {len(answers)}; named first: {first}"


def line(one: Answer) -> str:
    """Return one answer as text."""
    effect = f"{one.case.effect} {one.case.size_mm:g} mm" if one.case.effect else "nothing"
    said = "; ".join(", ".join(members) for members in one.sets) or "nothing named"
    taken = "" if one.absorbed is None else f", calibration takes up {100 * one.absorbed:.0f} %"
    unknown = " UNKNOWN" if one.unknown else ""
    return f"{effect:<44} -> {said}{unknown} (gap {one.before:.2f} to {one.after:.2f} mm{taken})"


@click.command()
@click.option("--what", multiple=True, default=("single", "nothing"), show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--size-mm", default=6.0, show_default=True, help="RMS of each effect.")
@click.option("--nothing", default=200, show_default=True, help="Recordings without an effect.")
@click.option("--workers", default=2, show_default=True)
def main(what: tuple[str, ...], seed: int, size_mm: float, nothing: int, workers: int) -> None:
    """Diagnose recordings of the project's own simulator."""
    first = 1_000_000 * (seed + 1)
    cases = {
        "single": [Case(first + 1000 + k, name, size_mm) for k, name in enumerate(EFFECTS)],
        "nothing": [Case(first + k) for k in range(nothing)],
    }
    with ProcessPoolExecutor(workers) as pool:
        for kind in what:
            found = pool.map(answer, cases[kind])
            answers = list(tqdm(found, kind, len(cases[kind]), leave=False))
            shown = [one for one in answers if kind != "nothing" or one.named or one.unknown]
            click.echo("\n".join([kind, *(f"  {line(one)}" for one in shown), told(kind, answers)]))


if __name__ == "__main__":
    main()
