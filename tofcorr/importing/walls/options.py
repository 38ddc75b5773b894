"""What can be chosen about finding walls."""

from typing import Literal

from pydantic import Field, PositiveFloat, PositiveInt

from tofcorr.options import Options


class WallOptions(Options):
    """How walls are found in depth images and matched between them.

    Attributes:
        tolerance_mm: How far a pixel's distance may be from its plane's, along the ray. It leaves
            room for the error of a camera that is not calibrated yet. Two planes of one image are
            told apart if they are more than twice this tolerance apart.
        least_share: Smallest share of an image's pixels that makes a plane.
        most_planes: Largest number of planes taken from one image, the largest first.
        fewest_images: A wall that fewer images show is left out.
        up: `z`: the world's z axis points up, so that the lowest horizontal wall is called `floor`;
            `unknown`: every wall gets a number.
    """

    tolerance_mm: PositiveFloat = 30.0
    least_share: float = Field(default=0.05, gt=0.0, lt=1.0)
    most_planes: PositiveInt = 6
    fewest_images: int = Field(default=6, ge=3)
    up: Literal["z", "unknown"] = "z"
