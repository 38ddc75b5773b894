"""What a module's state holds besides numbers: options, camera, depth kind and ranges."""

from dataclasses import asdict
from typing import Any, NamedTuple

from tofcorr.correction.state import DepthKind
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.geometry.intrinsics import CameraIntrinsics
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
    """

    options: TrainingOptions
    terms: ErrorModelOptions
    camera: CameraIntrinsics
    depth_kind: DepthKind
    domain: Domain
    saturation_amplitude: float | None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "options": self.options.to_mapping(),
            "terms": self.terms.to_mapping(),
            "camera": asdict(self.camera),
            "depth_kind": self.depth_kind,
            "domain": asdict(self.domain),
            "saturation_amplitude": self.saturation_amplitude,
        }

    @classmethod
    def from_mapping(cls, values: dict[str, Any], where: str) -> "Labels":
        """Read what `to_mapping` gave.

        Raises:
            ConfigError: An option is unknown to this version of the package.
        """
        camera, domain = values["camera"], values["domain"]
        return cls(
            options=TrainingOptions.from_mapping(values["options"], where),
            terms=ErrorModelOptions.from_mapping(values["terms"], where),
            camera=CameraIntrinsics(
                width=camera["width"],
                height=camera["height"],
                matrix=tuple(tuple(row) for row in camera["matrix"]),  # type: ignore[arg-type]
                distortion=tuple(camera["distortion"]),
            ),
            depth_kind=values["depth_kind"],
            domain=domain_from_mapping(domain),
            saturation_amplitude=values["saturation_amplitude"],
        )


def domain_from_mapping(values: dict[str, Any]) -> Domain:
    """Return the ranges whose `asdict` went through JSON."""
    intervals: dict[str, Any] = {
        key: None if values[key] is None else Interval(*values[key])
        for key in ("radial_distance", "amplitude", "normalised_amplitude")
    }
    conditions = {name: tuple(known) for name, known in values["conditions"].items()}
    values = values | intervals | {"conditions": conditions}
    return Domain(**values)
