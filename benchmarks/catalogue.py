"""Does the diagnosis name effects that its own simulator can make? A check of algebra and power.

    python -m benchmarks.catalogue --seed 0 [--what single|nothing|pairs|left_out ...]

Every recording has poses, light, noise and the effect's own coefficients (drawn from their prior,
scaled to the size asked for) from its seed. The simulator under diagnosis is fitted to the
recording and has none of them. `benchmarks/withheld` asks the harder question, with another
generator.
"""

import itertools
import json
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import torch
from scipy.stats import binomtest
from tqdm import tqdm

from benchmarks.withheld.tiers import HOLDERS
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.gap import draw_resamples, measure_gap
from tofcorr.diagnosis.findings.open_set import judge_remainder, name_in_two
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
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


@dataclass(frozen=True, kw_only=True)
class Case:
    """A recording to be made and diagnosed.

    Attributes:
        kind: What question it belongs to.
        seed: Of everything random in it.
        effects: Names and sizes, millimetres RMS.
        leave_out: What the catalogue must do without.
    """

    kind: str
    seed: int
    effects: tuple[tuple[str, float], ...] = ()
    leave_out: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What was said of a case; gaps in millimetres.

    Attributes:
        case: What was asked.
        named: Effects named.
        sets: Of each what cannot be told from it.
        unknown: Whether a gap remains unexplained.
        absorbed: Share of the true effect that calibration takes up.
        before: Gap of the base model.
        after: Gap with the named effects.
        alike: With the true effect in the catalogue again, the name given without it stands in one
            set with it: these data cannot tell the two apart.
    """

    case: Case
    named: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    unknown: bool
    absorbed: float | None
    before: float
    after: float
    alike: bool = False

    @property
    def wrong(self) -> bool:
        """Whether a single effect is named and nothing said of an unknown one."""
        return not self.unknown and any(len(members) == 1 for members in self.sets)

    @property
    def truths(self) -> set[str]:
        """Effects that are there."""
        return {name for name, _ in self.case.effects}

    @property
    def covered(self) -> bool:
        """Whether all effects stand in the sets."""
        return self.truths <= {name for members in self.sets for name in members}


def simulator_options(case: Case) -> SimulatorOptions:
    """Return the simulator of a case, without its effects."""
    values = load_options(SimulatorOptions, CONFIG).to_mapping()
    if any(name in NEED_MOTION for name, _ in case.effects):
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
    """Simulate and diagnose one case; draw it anew if its effects leave no pixel usable."""
    try:
        return _answer(case)
    except CalibrationDataError:
        return _answer(replace(case, seed=case.seed + 500_000))


def _answer(case: Case) -> Answer:
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(case.seed)
    plain = simulator_options(case)
    with tempfile.TemporaryDirectory() as folder:
        quiet, path = Path(folder) / "quiet", Path(folder) / "recording"
        entries = []
        if case.effects:
            simulate(plain, quiet, noise=False)
            observed = observe(Recording.open(quiet), 100_000)
            inputs = effect_inputs(observed, plain.hand_eye.tool_from_camera())
            entries = [drawn_effect(*effect, inputs, generator) for effect in case.effects]
        simulate(plain.model_copy(update={"effects": tuple(entries)}), path)
        recording = Recording.open(path)
        found = _diagnosed(case, recording)
        if case.leave_out and found.wrong:
            whole = _diagnosed(replace(case, leave_out=()), recording)
            alike = any(found.truths | set(found.named) <= set(members) for members in whole.sets)
            return replace(found, alike=alike)
        return found


def _diagnosed(case: Case, recording: Recording) -> Answer:
    options = DiagnosisOptions(leave_out=case.leave_out)
    study = prepare(recording, options, None).study
    resamples = draw_resamples(study, torch.Generator().manual_seed(1))
    named = name_in_two(study, resamples)
    gap = measure_gap(study, named, resamples)
    truth = next((name for name, _ in case.effects if name in study.candidates.effects), None)
    return Answer(
        case=case,
        named=named.names,
        sets=named.cause_sets,
        unknown=judge_remainder(study, named, gap).unknown,
        absorbed=None if truth is None else absorbed_share(study, truth),
        before=1e3 * gap.before,
        after=1e3 * gap.after,
    )


def cases_of(kind: str, seed: int, size_mm: float, nothing: int) -> Iterator[Case]:
    """Yield the cases of one question."""
    first = 1_000_000 * (seed + 1)
    if kind == "nothing":
        for k in range(nothing):
            yield Case(kind=kind, seed=first + k)
    if kind == "single":
        for k, name in enumerate(EFFECTS):
            yield Case(kind=kind, seed=first + 1000 + k, effects=((name, size_mm),))
    if kind == "left_out":
        for k, name in enumerate(EFFECTS):
            one, without = ((name, size_mm),), (name, *HOLDERS.get(name, ()))
            yield Case(kind=kind, seed=first + 2000 + k, effects=one, leave_out=without)
    if kind == "pairs":
        pairs = list(itertools.combinations(EFFECTS, 2))
        chosen = torch.randperm(len(pairs), generator=torch.Generator().manual_seed(seed))[:40]
        for k, number in enumerate(chosen.tolist()):
            two = tuple((name, size_mm) for name in pairs[number])
            yield Case(kind=kind, seed=first + 3000 + k, effects=two)


def told(kind: str, answers: list[Answer]) -> list[str]:
    """Return the findings of one question in lines."""
    count = len(answers)
    if kind == "nothing":
        false = sum(bool(one.named) for one in answers)
        low, high = binomtest(false, count).proportion_ci(method="wilson")
        unknown = sum(one.unknown for one in answers)
        share = f"{false / count:.3f} [{low:.3f}, {high:.3f}]"
        return [f"an effect named in {false} of {count}: {share}; called unknown: {unknown}"]
    if kind == "single":
        right = sum(one.covered and max(map(len, one.sets)) <= 3 for one in answers)
        first = sum(one.named[:1] == tuple(one.truths) for one in answers)
        return [f"in a set of at most 3: {right} of {count}; named first: {first}"]
    if kind == "left_out":
        unknown = sum(one.unknown for one in answers)
        silent = sum(not one.named and not one.unknown for one in answers)
        wrong = sum(one.wrong for one in answers)
        alike = sum(one.alike for one in answers)
        return [
            f"unknown: {unknown}, nothing: {silent}, a wrong single name: {wrong} of {count}, "
            f"of which {alike} cannot be told from the truth even where both are considered"
        ]
    named = sum(len(one.named) for one in answers)
    hits = sum(len(one.truths & set(one.named)) for one in answers)
    inside = sum(one.covered for one in answers)
    return [
        f"recall {hits / (2 * count):.2f}, precision {hits / max(named, 1):.2f}, "
        f"both in sets: {inside} of {count}"
    ]


def line(one: Answer) -> str:
    """Return one answer as text."""
    effects = ", ".join(f"{name} {size:g} mm" for name, size in one.case.effects) or "nothing"
    said = "; ".join(", ".join(members) for members in one.sets) or "nothing named"
    taken = "" if one.absorbed is None else f", calibration takes up {100 * one.absorbed:.0f} %"
    unknown = " UNKNOWN" if one.unknown else " (cannot be told from the truth)" if one.alike else ""
    return f"{effects:<44} -> {said}{unknown} (gap {one.before:.2f} to {one.after:.2f} mm{taken})"


@click.command()
@click.option("--what", multiple=True, default=("single", "nothing", "pairs", "left_out"))
@click.option("--seed", default=0, show_default=True)
@click.option("--size-mm", default=6.0, show_default=True, help="RMS of each effect.")
@click.option("--nothing", default=200, show_default=True, help="Recordings without an effect.")
@click.option("--workers", default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="JSON file of all answers.")
def main(
    what: tuple[str, ...], seed: int, size_mm: float, nothing: int, workers: int, out: Path | None
) -> None:
    """Diagnose recordings of the project's own simulator."""
    found: dict[str, list[Answer]] = {}
    with ProcessPoolExecutor(workers) as pool:
        for kind in what:
            cases = list(cases_of(kind, seed, size_mm, nothing))
            answers = list(tqdm(pool.map(answer, cases), kind, len(cases), leave=False))
            found[kind] = answers
            shown = [one for one in answers if kind != "nothing" or one.named or one.unknown]
            click.echo(
                "\n".join([kind, *(f"  {line(one)}" for one in shown), *told(kind, answers)])
            )
    if out is not None:
        listed = {kind: [asdict(one) for one in answers] for kind, answers in found.items()}
        out.write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
