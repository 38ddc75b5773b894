"""Words of a picture."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Caption:
    """Words of a picture.

    Attributes:
        finding: What it shows in this diagnosis.
        reading: How to read it.
        alt: What it is a picture of, for those who cannot see it.
    """

    finding: str
    reading: str
    alt: str
