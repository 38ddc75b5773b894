"""Something that a fit takes as given, and what an error of it would do."""

from typing import Any, NamedTuple

from torch import Tensor

from tofcorr.fit.misfit.twist_mapping import twist_mapping


class Assumption(NamedTuple):
    """What an error of something that the fit takes as given would do to the hand-eye transform.

    Attributes:
        name: Of the error, for programs, such as `focal_length`.
        error: In words, such as "focal length 0.1 % longer": of what the recording should say.
        twist: How far the transform would move, in camera axes, translation first, shape (6,),
            metres and radians.
    """

    name: str
    error: str
    twist: Tensor

    def to_mapping(self, rotation: Tensor) -> dict[str, Any]:
        """Return plain values for JSON, along the tool's axes.

        Args:
            rotation: Of tool_from_camera, shape (3, 3).
        """
        return {
            "name": self.name,
            "error": self.error,
            **twist_mapping(self.twist, rotation),
        }
