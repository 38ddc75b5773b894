"""Types of the numbers in the simulator's options."""

from typing import Annotated

from pydantic import Field

from tofcorr.data.recording import Number, PositiveNumber

__all__ = ["Count", "NonNegativeNumber", "Number", "PositiveNumber", "Range", "Share", "Vector3"]

NonNegativeNumber = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Range = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
