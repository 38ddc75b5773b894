"""What estimated planes absorb: said by name, and not judged where hardly anything remains."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import left_over
from tofcorr.diagnosis.sums.study import Study, build_study
from tofcorr.simulation.effects.needs import MEASURED_PLANES

# An effect is not judged if estimated planes absorb more than this share of what measured planes
# would leave of it: a twentieth of an effect looks like others. Chosen.
_NOT_JUDGED = 0.95
# Above this share a warning names the effect. Chosen: its smallest detectable size has grown by
# more than a factor of 1.4.
_WORTH_SAYING = 0.5
# An effect of which measured planes would leave less than this share has no share to compute: it
# would be a quotient of two rounding errors. Chosen.
_NOTHING_LEFT = 0.005


def without_absorbed(study: Study) -> tuple[Study, list[str]]:
    """Return the study without the effects that estimated planes absorb, and a warning.

    The effects left out are among `missing`: they need measured planes. A study of measured planes
    stays as it is.
    """
    if not study.observations.num_walls:
        return study, []
    shares = {name: absorbed_by_planes(study, name) for name in study.candidates.effects}
    hidden = [name for name, share in shares.items() if share > _NOT_JUDGED]
    if hidden:
        study = _without(study, hidden)
    partly = [
        f"{name} ({100 * share:.0f} %)"
        for name, share in shares.items()
        if _WORTH_SAYING < share <= _NOT_JUDGED
    ]
    return study, [_warning(study, partly)]


def _without(study: Study, names: Sequence[str]) -> Study:
    """Return the study without some effects, drawn again from the same seed."""
    leave_out = (*study.options.leave_out, *names)
    options = study.options.model_copy(update={"leave_out": leave_out})
    generator = torch.Generator().manual_seed(options.seed)
    again = build_study(options, study.observations, study.fit, study.inputs, generator)
    missing = {**again.candidates.missing, **{name: [MEASURED_PLANES.words] for name in names}}
    candidates = replace(again.candidates, missing=missing)
    return replace(again, options=study.options, candidates=candidates)


def _warning(study: Study, partly: Sequence[str]) -> str:
    count, missing = study.observations.num_walls, study.candidates.missing
    unjudged = [name for name, wants in missing.items() if MEASURED_PLANES.words in wants]
    planes = "plane of 1 wall is" if count == 1 else f"planes of {count} walls are"
    sentence = f"The {planes} estimated together with the base model (recording.yaml: planes)."
    if unjudged:
        sentence += f" Not judged, because measured planes are needed: {', '.join(unjudged)}."
    if partly:
        sentence += f" Estimated planes absorb a large share of {', '.join(partly)}."
    return sentence


def absorbed_by_planes(study: Study, name: str) -> float:
    """Return the share that estimated planes absorb of what measured planes would leave."""
    sums, model = study.system.blocks.even, study.fit.model
    low, high = sums.layout.effects[name]
    gram = sums.total
    everything = torch.arange(sums.layout.base)
    planes = (everything >= model.num_hand_eye) & (everything < model.num_geometry)

    def left(members: Tensor) -> float:
        prior = sums.layout.prior_of(members)
        return float(left_over(gram, members, low, high, prior).trace())

    measured, estimated = left(everything[~planes]), left(everything)
    whole = float(gram[low:high, low:high].trace())
    return 1.0 - estimated / measured if measured > _NOTHING_LEFT * whole else 0.0
