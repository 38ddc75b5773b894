"""Cases: a world, the effects in it, its recording, and what is true of them."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.forms import INSIDE, OUTSIDE
from benchmarks.renewed.geometry import Array, Random
from benchmarks.renewed.recording import Recorded, Truth, record, write_recording
from benchmarks.renewed.signal_chain import Change, Form, Hook, noise_of, scaled
from benchmarks.renewed.world import World, draw_world
from benchmarks.sealed.answers import Entry, seal

TIERS = {"E": INSIDE, "N": (), "O": OUTSIDE}  # an effect, nothing, one outside any catalogue


@dataclass(frozen=True)
class Case:
    """One recording and its truth."""

    world: World
    hooks: tuple[Hook, ...]
    recorded: Recorded
    truth: Truth

    @cached_property
    def sizes_mm(self) -> dict[str, float]:
        """RMS of each effect over the pixels on the target."""
        return self.truth.sizes_mm(self.recorded)

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of the noise (N, H, W), metres."""
        return noise_of(self.world, self.hooks)

    def described(self) -> dict[str, Any]:
        """Design and sensor, and the form if there is one, as an answer says them."""
        sensor, forms = self.world.sensor, [hook.form for hook in self.hooks]
        (form,) = forms if len(forms) == 1 else (None,)
        return {
            "effect": form.effect if form else None,
            "form": form.name if form else None,
            "textbook": form.textbook if form else None,
            "design": asdict(self.world.design) | {"poses": self.world.way.poses},
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


def make_case(
    rng: Random,
    forms: Sequence[Form] = (),
    sizes: ranges.Range = ranges.RANGES["sizes_mm"],
    wanted: Mapping[str, Any] | None = None,
) -> Case:
    """Draw a world that shows all forms, and record it; `wanted` fixes more of its design."""
    world = draw_world(rng, wanted_by(forms) | dict(wanted or {}))
    hooks = []
    for form in forms:
        size = sizes.draw(rng) * 1e-3
        hooks.append(scaled(world, form, form.draw(rng, world), size))
    return Case(world, tuple(hooks), *record(rng, world, hooks))


def seeded(forms: Sequence[Form], seed: int) -> tuple[Form, ...]:
    """The forms, each drawn by a generator of its own: another session has the same effects."""

    def draw(form: Form) -> Callable[[Random, World], Change]:
        return lambda _, world: form.draw(np.random.default_rng(seed), world)

    return tuple(replace(form, draw=draw(form)) for form in forms)


def in_world(world: World, hooks: Sequence[Hook]) -> tuple[Hook, ...]:
    """The effects of seeded forms in another world of the same camera."""
    rng = np.random.default_rng()  # which they do not ask
    return tuple(Hook(one.form, one.form.draw(rng, world), one.strength) for one in hooks)


def wanted_by(forms: Sequence[Form]) -> dict[str, Any]:
    """What the design must be like for all forms."""
    wanted = {key: value for form in forms for key, value in form.wanted.items()}
    logged = tuple(name for form in forms for name in form.wanted.get("logged", ()))
    return wanted | ({"logged": logged} if logged else {})


def agree(forms: Sequence[Form]) -> bool:
    """Whether the forms are of different effects, and one design is like all want it."""
    wanted = wanted_by(forms) | {"logged": None}
    alike = all(wanted[k] == one.wanted[k] for one in forms for k in one.wanted.keys() - {"logged"})
    return alike and len({form.effect for form in forms}) == len(forms)


def turn(seed: int, forms: Sequence[Form], index: int) -> Form:
    """The form whose turn it is: every one once in each round, in an order of the round's own.

    The order depends on the seed, so that a run of few cases is a sample of all forms.
    """
    order = np.random.default_rng([seed, index // len(forms)]).permutation(len(forms))
    return forms[order[index % len(forms)]]


def write_case(seed: int, tier: str, index: int, out: Path) -> Entry:
    """Write one case; return the manifest's entry. It depends on seed, tier and index alone."""
    rng = np.random.default_rng([seed, list(TIERS).index(tier), index])
    case = make_case(rng, [turn(seed, TIERS[tier], index)] if TIERS[tier] else ())
    return write_sealed(rng, case, out, {"tier": tier}, {"role": "main", "index": index})


def write_sealed(
    rng: Random, case: Case, out: Path, about: Entry, role: Entry, without: Collection[str] = ()
) -> Entry:
    """Write a recording `without` some columns or files, and its answer; return its entry."""
    name = f"r{rng.integers(2**48):012x}"
    write_recording(out / "recordings" / name, case.recorded, without)
    arrays = {f"field_{effect}": field for effect, field in case.truth.fields.items()}
    answer = {
        **role,
        "id": name,
        "case": {**about, **case.described()},
        "sizes_mm": case.sizes_mm,
        "strengths": {hook.form.effect: hook.strength for hook in case.hooks},
    }
    arrays |= {"expected": case.truth.expected, "noise": case.noise}
    return {"id": name, "exclude": [], "answer_sha256": seal(rng, out, answer, arrays)}
