"""Names effects, a second time where a gap is certain and no single effect was significant.

With few poses a test of twenty effects has little power: a cause must be far beyond what each of
them reaches by chance. That guards against a name where nothing is missing. The tests behind
`unknown` ask the same of the recording as a whole, at the same level. Where they find that
something is missing, nothing is left to guard against, and an effect need be significant by itself
only (a gatekeeping procedure; Dmitrienko, Offen and Westfall 2003).
"""

from torch import Tensor

from tofcorr.diagnosis.findings.how_far import measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.open_set import judge_remainder
from tofcorr.diagnosis.sums.study import Study


def name_in_two(study: Study, resamples: Tensor) -> NamedEffects:
    """Name effects; where none is and a gap is certain, name the one that explains most of it.

    Args:
        study: The recording.
        resamples: How often each resample holds each pose, shape (B, U); for the gap.
    """
    named = name_effects(study)
    if named.names or not named.likeliest:
        return named
    remainder = judge_remainder(study, named, measure_gap(study, named, resamples))
    return name_effects(study, certain=True) if remainder.unknown else named
