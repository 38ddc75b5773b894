"""An error that a fitted model lacks, as far as the result is concerned."""

from typing import Any, NamedTuple

from torch import Tensor

from tofcorr.fit.misfit.twist_mapping import twist_mapping


class Misfit(NamedTuple):
    """An error that the model lacks.

    Attributes:
        probe: Name of the pattern that shows it.
        trace: What the residuals do: it follows "the residuals".
        p_value: Probability of such residuals by chance, with all probes that were tried.
        twist: How far the hand-eye transform would move with a term for it, in camera axes,
            translation first, shape (6,), metres and radians.
    """

    probe: str
    trace: str
    p_value: float
    twist: Tensor

    @property
    def shift(self) -> float:
        """How far the camera would move, metres."""
        return float(self.twist[:3].norm())

    @property
    def turn(self) -> float:
        """How far it would turn, radians."""
        return float(self.twist[3:].norm())

    def in_words(self) -> str:
        """Return one sentence for the user."""
        return (
            f"The residuals {self.trace}: the model lacks a term. With one, the hand-eye transform "
            f"would lie {1e3 * self.shift:.1f} mm and {1e3 * self.turn:.1f} mrad from this one. "
            "Its standard errors are widened by that; `tofcorr diagnose` looks for the cause."
        )

    def to_mapping(self, rotation: Tensor) -> dict[str, Any]:
        """Return plain values for JSON, along the tool's axes.

        Args:
            rotation: Of tool_from_camera, shape (3, 3).
        """
        return {
            "probe": self.probe,
            "residuals": self.trace,
            "p_value": self.p_value,
            **twist_mapping(self.twist, rotation),
        }
