"""All forms of all effects: every effect in at least three physically different ones."""

from benchmarks.renewed.forms import (
    electronics,
    geometry,
    heat,
    light,
    motion,
    outside,
    patterns,
    surface,
)
from benchmarks.renewed.generator.form import Form

INSIDE: tuple[Form, ...] = (
    *electronics.FORMS,
    *heat.FORMS,
    *patterns.FORMS,
    *geometry.FORMS,
    *motion.FORMS,
    *light.FORMS,
    *surface.FORMS,
)
OUTSIDE: tuple[Form, ...] = outside.FORMS
EFFECTS = tuple(dict.fromkeys(form.effect for form in INSIDE))


def forms_of(effect: str) -> tuple[Form, ...]:
    """The forms of an effect, the one of the textbooks first."""
    return tuple(form for form in (*INSIDE, *OUTSIDE) if form.effect == effect)
