"""What a verdict looks at: the fit, its errors and the noise of its pixels."""

import math
from collections.abc import Callable
from typing import NamedTuple

from tofcorr.fit.result import Fit
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.support import Support


class Evidence(NamedTuple):
    """What is known of a fitted model.

    Attributes:
        fit: The fitted model.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings.
        held_out: RMS error of held-out frames, millimetres; None: no frame was held out.
        fitted: The same of the fitted frames.
        bare: Of held-out frames with the hand-eye transform alone, millimetres.
        noise: Noise of a pixel, millimetres; NaN: unknown.
        noise_rms: Its root mean square over all pixels, millimetres; NaN: unknown.
    """

    fit: Fit
    support: Support
    inspection: Inspection
    held_out: float | None
    fitted: float
    bare: float | None
    noise: float
    noise_rms: float

    def measured(self) -> str:
        """Return the held-out error beside what it is compared with."""
        text = f"Held-out frames are off by {self.held_out:.1f} mm RMS"
        compared = [] if self.bare is None else [f"{self.bare:.1f} mm with the hand-eye alone"]
        if math.isfinite(self.noise):
            compared.append(f"{self.noise:.1f} mm noise of a pixel")
        return f"{text} ({', '.join(compared)})" if compared else text


Rule = Callable[[Evidence], str | None]
"""Looks at one thing; gives the reason against a run in one sentence, None where it is fine."""
