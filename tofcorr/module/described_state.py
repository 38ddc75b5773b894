"""What a module's state holds besides numbers: options, camera, depth kind and ranges."""

from dataclasses import asdict
from typing import Any, NamedTuple

from tofcorr.correction.state_file import CameraEntry, DepthKind, DomainEntry
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import Options
from tofcorr.options.numbers import PositiveNumber
from tofcorr.training.options import TrainingOptions


class Labels(NamedTuple):
    """What a module says of itself besides the numbers that its output depends on.

    Attributes:
        options: How it is fitted.
        terms: Its terms, with what a fit found in the data.
        camera: The lateral parameters.
        depth_kind: What depth means.
        domain: The calibrated ranges.
        saturation_amplitude: None if unknown.
        hand_eye_estimated: Whether the hand-eye transform was estimated, or known beforehand.
    """

    options: TrainingOptions
    terms: ErrorModelOptions
    camera: CameraIntrinsics
    depth_kind: DepthKind
    domain: Domain
    saturation_amplitude: float | None
    hand_eye_estimated: bool = True

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "options": self.options.to_mapping(),
            "terms": self.terms.to_mapping(),
            "camera": asdict(self.camera),
            "depth_kind": self.depth_kind,
            "domain": asdict(self.domain),
            "saturation_amplitude": self.saturation_amplitude,
            "hand_eye_estimated": self.hand_eye_estimated,
        }

    @classmethod
    def from_mapping(cls, values: dict[str, Any], where: str) -> "Labels":
        """Read what `to_mapping` gave.

        Raises:
            ConfigError: An option is unknown to this version of the package.
        """
        entry = _LabelsEntry.from_mapping(values, where)
        return cls(
            options=entry.options,
            terms=entry.terms,
            camera=entry.camera.intrinsics(),
            depth_kind=entry.depth_kind,
            domain=entry.domain.domain(),
            saturation_amplitude=entry.saturation_amplitude,
            hand_eye_estimated=entry.hand_eye_estimated,
        )


class _LabelsEntry(Options):
    """What `to_mapping` gives, after JSON."""

    options: TrainingOptions
    terms: ErrorModelOptions
    camera: CameraEntry
    depth_kind: DepthKind
    domain: DomainEntry
    saturation_amplitude: PositiveNumber | None = None
    hand_eye_estimated: bool = True
