"""The file `sensor.yaml`: the camera as it was found."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field

from tofcorr.conditions import condition
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.condition_terms import NAME_OF
from tofcorr.error_terms.registry import TermOptions
from tofcorr.estimation.noise import NoiseModel
from tofcorr.estimation.robust import LEVEL
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.geometry.se3 import RigidTransform
from tofcorr.observables.measure import DropoutModel
from tofcorr.observables.read import Observed
from tofcorr.options import (
    NonNegativeNumber,
    Number,
    Options,
    PositiveNumber,
    Range,
    among,
    dump_yaml,
    resolve_options,
    shipped_names,
)
from tofcorr.scene_light.bounces import SecondBouncesState
from tofcorr.simulation.options import CameraOptions
from tofcorr.simulation.scene import UniformTarget

FILE_NAME = "sensor.yaml"

_HEADING = """\
# {title}
# `tofcorr degrade --sensor THIS_FILE` and `tofcorr.SensorModel.load` read this file.
# error: measured = true + error along the ray; symbols and units are those of calibration.yaml.
# effects: as in a simulator's YAML. noise, dropouts: of one pixel in one frame.
# Lengths are metres; amplitudes are in the camera's own linear units.
"""


_Column = Annotated[str, among(NAME_OF, "condition")]


class ErrorSection(Options):
    """The error terms, with their coefficients in the paper's symbols.

    Attributes:
        reads: Which distance the terms are functions of: `true_distance` after a diagnosis,
            `measured_distance` after a training.
        terms: Kinds and options, as in `calibration.yaml`.
        coefficients: By group and symbol, metres, pixels and the camera's amplitude units; null
            where a symbol has no value, such as the vertex of a parabola without curvature.
    """

    reads: Literal["true_distance", "measured_distance"] = "true_distance"
    terms: tuple[TermOptions, ...] = ()
    coefficients: dict[str, dict[str, Number | None]] = Field(
        default_factory=lambda: {"distance": {"c0": 0.0}}
    )


class ConditionRange(Options):
    """Lowest, highest and mean value of one condition, in the unit of its name."""

    low: Number
    high: Number
    mean: Number

    def in_si_units(self, column: str) -> tuple[float, float, float]:
        """Return the three in the unit of `Conditions`."""
        unit = condition(NAME_OF[column]).si_per_unit
        return self.low * unit, self.high * unit, self.mean * unit


class ValiditySection(Options):
    """The ranges that the camera was measured in; beyond them the error at the edge is used.

    Attributes:
        radial_distance_m: Measured distances along the ray.
        true_radial_distance_m: True distances of the same pixels; null: those whose measured ones,
            by the error terms alone, fill that range.
        amplitude: Null: not recorded.
        normalised_amplitude: Amplitude times squared distance.
        conditions: By the name of their column in `frames.csv`.
    """

    radial_distance_m: Range
    true_radial_distance_m: Range | None = None
    amplitude: Range | None = None
    normalised_amplitude: Range | None = None
    conditions: dict[_Column, ConditionRange] = Field(default_factory=dict)


class LightSection(Options):
    """The amplitude that a surface returns, for scenes that state a reflectivity.

    Attributes:
        amplitude_at_1m: Of a frontal surface of reflectivity 1 at 1 m, on the optical axis.
        vignetting_exponent: n of cos^n of the angle to the optical axis.
        usual_reflectivity: Taken where a scene states neither amplitude nor reflectivity.
    """

    amplitude_at_1m: PositiveNumber
    vignetting_exponent: NonNegativeNumber = 0.0
    usual_reflectivity: Annotated[Number, Field(gt=0, le=1)] = 0.5


class SensorFile(Options):
    """The content of `sensor.yaml`.

    Attributes:
        title: What the camera is, in one line.
        measured_from: What it was measured from, and what is not known, a sentence each.
        camera: The lateral parameters.
        depth_kind: `radial`: along the ray; `z`: along the optical axis.
        modulation_frequency_hz: Null if unknown.
        tool_from_camera: The hand-eye transform that the errors were found with; null: none. The
            two go together: ideal frames of this robot are to be rendered with it.
        error: Error terms.
        effects: Effects beyond the error terms, as in a simulator's YAML.
        effects_see: The distance that effects and error terms depend on. `true_distance`: as a
            diagnosis fits them, side by side; `delayed_distance`: as the simulator runs them, the
            error terms at what the lens makes of it, mixed signals at what all delays make of it.
        noise: Null: unknown, none is drawn.
        dropouts: Null: unknown, every pixel gives a distance.
        light: Null: unknown; scenes then need amplitudes, where anything depends on them.
        validity: The ranges of what was measured.
        second_bounces: Light by further surfaces, added to what a scene returns; null: none.
    """

    config_folder: ClassVar[str] = "sensor"

    format: Literal["tofcorr-sensor"]
    version: Annotated[Literal[1], BeforeValidator(lambda v: None if v is True else v)]
    title: str = "A time-of-flight camera, as it was found."
    measured_from: tuple[str, ...] = ()
    camera: CameraOptions
    depth_kind: DepthKind
    modulation_frequency_hz: PositiveNumber | None = None
    tool_from_camera: RigidTransform | None = None
    error: ErrorSection = ErrorSection()
    effects: tuple[dict[str, Any], ...] = ()
    effects_see: Literal["true_distance", "delayed_distance"] = "true_distance"
    noise: NoiseModel | None = None
    dropouts: DropoutModel | None = None
    light: LightSection | None = None
    validity: ValiditySection
    second_bounces: SecondBouncesState | None = None

    def ending_with_the_image(self, patch_px: int | None = None) -> Self:
        """Return the same without surfaces beyond the image: for frames with surroundings.

        Args:
            patch_px: Side of its patches; None: as it is.
        """
        if self.second_bounces is None:
            return self
        patch_px = patch_px or self.second_bounces.patch_px
        changes = {"continued": False, "patch_px": patch_px}
        ending = self.second_bounces.model_copy(update=changes)
        return self.model_copy(update={"second_bounces": ending})

    def intrinsics(self) -> CameraIntrinsics:
        """Return the camera."""
        return self.camera.intrinsics()

    def domain(self) -> Domain:
        """Return image size and ranges, which scale the variables of the error terms."""
        validity = self.validity
        return Domain(
            height=self.camera.height,
            width=self.camera.width,
            radial_distance=Interval(*validity.radial_distance_m),
            amplitude=validity.amplitude and Interval(*validity.amplitude),
            normalised_amplitude=validity.normalised_amplitude
            and Interval(*validity.normalised_amplitude),
            modulation_frequency=self.modulation_frequency_hz,
            conditions={NAME_OF[c]: own.in_si_units(c) for c, own in validity.conditions.items()},
        )


def validity_of(domain: Domain) -> ValiditySection:
    """Return the section of calibrated ranges."""
    conditions = {}
    for name, numbers in domain.conditions.items():
        values = map(condition(name).in_file, numbers)
        conditions[condition(name).column] = dict(zip(("low", "high", "mean"), values, strict=True))
    return ValiditySection(
        radial_distance_m=domain.radial_distance,
        amplitude=domain.amplitude,
        normalised_amplitude=domain.normalised_amplitude,
        conditions=conditions,
    )


def read_sensor(sensor: str | Path) -> SensorFile:
    """Read a sensor: a shipped name such as `"kinect_v2"`, a file, or a report that holds one.

    Args:
        sensor: The name, `sensor.yaml`, or the folder that `tofcorr diagnose` wrote.

    Raises:
        ConfigError: There is none, or it breaks the format; the message names the key.
    """
    inside = Path(sensor) / "sensor.yaml"
    if str(sensor) not in shipped_names(SensorFile.config_folder) and inside.is_file():
        sensor = inside
    return resolve_options(SensorFile, sensor)


def sensor_text(sensor: SensorFile) -> str:
    """Return the text of the file, with a heading for people."""
    title = " ".join(sensor.title.split())
    return _HEADING.format(title=title) + dump_yaml(sensor.to_mapping(), last="depth_kind")


def dropout_section(model: DropoutModel, observed: Observed) -> DropoutModel:
    """Return measured missing pixels with the share of saturated ones, counted by themselves.

    Args:
        model: The probability that a pixel is missing.
        observed: What it was measured from.
    """
    table, saturated = observed.table, model.saturated(observed.table.raw_amplitude)
    if not saturated.any():
        return model
    share, rest = (
        float(table.missing[use].sum() / max(table.frames[use].sum(), 1))
        for use in (saturated, ~saturated)
    )
    darker = {"base_share": rest} if model.amplitude_at_half is None else {}
    return model.model_copy(update={"saturated_share": share, **darker})


def light_section(observed: Observed) -> LightSection | None:
    """Return the light of a camera, if its bright surfaces are white; None without amplitudes.

    Reflectivities are unknown: the 95 % quantile of the amplitude, less the fall-off with distance
    and incidence, is taken as white of the simulator's reflectivity, 0.8.
    """
    table = observed.table
    full = table.amplitude / table.signal
    full = full[np.isfinite(full) & (full > 0)]
    if not len(full):
        return None
    at_1m = float(np.quantile(full, 1 - LEVEL)) / UniformTarget().reflectivity
    usual = min(float(np.median(full)) / at_1m, 1.0)
    numbers = {"amplitude_at_1m": f"{at_1m:.4g}", "usual_reflectivity": f"{usual:.3g}"}
    return LightSection.model_validate(numbers)
