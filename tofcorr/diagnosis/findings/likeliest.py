"""The likeliest causes where poses are too few to make any of them significant."""

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, closed_square
from tofcorr.diagnosis.sums.study import Study

# At most so many are listed. Chosen: what a reader can follow up.
_MOST = 3


def likeliest(study: Study, last: EffectComparison) -> tuple[str, ...]:
    """Return the effects that may explain what remains, by their score, the likeliest first.

    Each closes at least the square of the target gap, and would be significant if it were the only
    one tested.

    Args:
        study: The recording.
        last: What could be added to the final model.
    """
    options = study.options
    least = (options.target_gap_mm * 1e-3) ** 2
    possible = [
        test
        for test in last.tests.values()
        if test.p_value <= options.tests.level and closed_square(study, test) >= least
    ]
    possible.sort(key=lambda test: -test.score)
    return tuple(test.name for test in possible[:_MOST])
