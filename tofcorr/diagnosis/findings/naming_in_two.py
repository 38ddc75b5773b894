"""Names effects, a second time where a gap is certain and no single effect was significant.

With few poses a test of twenty effects has little power: a cause must be far beyond what each of
them reaches by chance. That guards against a name where nothing is missing. The tests behind
`unknown` ask the same of the recording as a whole, at the same level. Where they find that
something is missing, nothing is left to guard against, and an effect need be significant by itself
only (a gatekeeping procedure; Dmitrienko, Offen and Westfall 2003).
"""

import torch

from tofcorr.diagnosis.findings.how_far import measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.open_set import judge_remainder
from tofcorr.diagnosis.findings.resamples import draw_resamples
from tofcorr.diagnosis.sums.study import Study

# Added to the diagnosis' seed for the resamples of the poses. Chosen: as where gaps are measured.
_SEED_OF_RESAMPLES = 1


def name_in_two(study: Study) -> NamedEffects:
    """Name effects; where none is and a gap is certain, name the one that explains most of it."""
    named = name_effects(study)
    if named.names or not named.likeliest:
        return named
    generator = torch.Generator().manual_seed(study.options.seed + _SEED_OF_RESAMPLES)
    gap = measure_gap(study, named, draw_resamples(study, generator))
    return (
        name_effects(study, certain=True) if judge_remainder(study, named, gap).unknown else named
    )
