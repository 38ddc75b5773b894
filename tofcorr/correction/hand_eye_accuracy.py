"""How well a calibration knows the hand-eye transform, for those who use it."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class HandEyeAccuracy:
    """Standard errors of a hand-eye transform, and what the recording does not determine of it.

    Attributes:
        translation_se_mm: Along the axes of the frame that carries the camera, millimetres.
        rotation_se_deg: About the same axes, degrees.
        undetermined: Combinations of unknowns that the images do not determine, such as `t_z`. A
            prior was used for them, and the standard errors do not include them.
    """

    translation_se_mm: tuple[float, float, float]
    rotation_se_deg: tuple[float, float, float]
    undetermined: tuple[str, ...] = ()
