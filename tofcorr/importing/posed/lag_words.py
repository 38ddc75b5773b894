"""What an import says of the lag between images and poses."""

import numpy as np

from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.timing.lag import Lag

_LEAST_NAMED = 0.005
"""Seconds: a lag below it moves a point by less than 1 mm at 0.2 m/s, and gets no warning."""

_SIGNIFICANT = 3.0
"""A lag is named from this many standard errors on: by chance one in 370 is."""


def lag_mapping(lag: Lag) -> dict[str, float | None]:
    """Return what `import.json` says of the lag."""
    correlation = None if np.isnan(lag.correlation) else round(lag.correlation, 3)
    return {
        "seconds": round(lag.seconds, 5),
        "standard_error": round(lag.standard_error, 5),
        "correlation": correlation,
    }


def lag_warnings(lag: Lag | None, options: PosedOptions) -> list[str]:
    """Return a sentence about a lag that was estimated and is not zero."""
    if lag is None or options.lag_s != "auto":
        return []
    if abs(lag.seconds) < max(_SIGNIFICANT * lag.standard_error, _LEAST_NAMED):
        return []
    when = "late" if lag.seconds > 0 else "early"
    return [
        f"Images are stamped {1e3 * abs(lag.seconds):.0f} ± {2e3 * lag.standard_error:.0f} ms "
        f"{when} against the poses; this lag was removed. Add --lag-s 0 to keep the stamps as they "
        "are."
    ]
