"""All forms of all effects: every effect in at least three physically different ones."""

from types import ModuleType

from benchmarks.renewed.forms import (
    electronics,
    further,
    geometry,
    heat,
    light,
    motion,
    outside,
    patterns,
    surface,
)
from benchmarks.renewed.signal_chain import Form


def _of(*modules: ModuleType) -> tuple[Form, ...]:
    """The forms that modules define, in their order, which draws of a seed depend on."""
    values = (value for module in modules for value in vars(module).values())
    return tuple(value for value in values if isinstance(value, Form))


INSIDE = _of(electronics, heat, patterns, geometry, motion, light, surface)
OUTSIDE = _of(outside)
EFFECTS = tuple(dict.fromkeys(form.effect for form in INSIDE))
FORM = {form.name: form for form in (*INSIDE, *OUTSIDE, *_of(further))}
