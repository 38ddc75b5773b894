"""Sections of `sensor.yaml` from what was measured of a recording."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from tofcorr.correction.state import CalibrationState
from tofcorr.data.recording import Recording
from tofcorr.errors import ConfigError
from tofcorr.observables import DropoutModel, NoiseCurve
from tofcorr.observables.observed import Observed
from tofcorr.sensor.base_error import section_of
from tofcorr.sensor.pixel_sections import DropoutSection, LightSection, NoiseSection
from tofcorr.sensor.sensor_file import ErrorSection, SensorCamera, SensorFile, validity_of

# Quantile of amplitude times squared distance per cosine that counts as white (no unit), and the
# reflectivity of white paper and paint. Chosen: reflectivities of real scenes are rarely measured.
_WHITE_QUANTILE = 0.95
_WHITE = 0.8


def noise_section(curve: NoiseCurve, *, pattern_is_an_effect: bool = False) -> NoiseSection:
    """Return the section of a measured noise.

    Args:
        curve: The noise.
        pattern_is_an_effect: Whether the fixed part stands among the effects, pixel by pixel; the
            noise then holds the rest.
    """
    numbers = asdict(curve)
    if pattern_is_an_effect:
        rest = math.sqrt(1 - curve.fixed_share)
        numbers |= {key: numbers[key] * rest for key in ("floor_m", "shot_m", "read_m")}
        numbers["fixed_share"] = 0.0
    return NoiseSection(**numbers)


def dropout_section(model: DropoutModel, observed: Observed) -> DropoutSection:
    """Return the section of measured missing pixels; saturated ones are counted by themselves.

    Args:
        model: The probability that a pixel is missing.
        observed: What it was measured from.
    """
    section = DropoutSection(**asdict(model))
    level, table = model.saturation_amplitude, observed.table
    if level is None:
        return section
    saturated = table.raw_amplitude >= level
    if not saturated.any():
        return section
    share = _share(table.missing[saturated], table.frames[saturated])
    changes: dict[str, float] = {"saturated_share": share}
    if model.amplitude_at_half is None:
        changes["base_share"] = _share(table.missing[~saturated], table.frames[~saturated])
    return section.model_copy(update=changes)


def _share(missing: np.ndarray, frames: np.ndarray) -> float:
    return float(missing.sum() / max(frames.sum(), 1))


def light_section(observed: Observed) -> LightSection | None:
    """Return the light of a camera, if its bright surfaces are white; None without amplitudes.

    Reflectivities are unknown: the 95 % quantile of the amplitude, less the fall-off with distance
    and incidence, is taken as white of reflectivity 0.8.
    """
    table = observed.table
    full = table.amplitude * table.distance**2 / table.cosine
    full = full[np.isfinite(full) & (full > 0)]
    if not len(full):
        return None
    white = float(np.quantile(full, _WHITE_QUANTILE))
    usual = float(np.clip(np.median(full) / white * _WHITE, 0.01, 1.0))
    return LightSection(
        amplitude_at_1m=float(f"{white / _WHITE:.4g}"), usual_reflectivity=round(usual, 3)
    )


def sensor_of_calibration(
    state: CalibrationState,
    recording: Recording,
    observed: Observed,
    curve: NoiseCurve,
    missing: DropoutModel,
    *,
    title: str,
    measured_from: Sequence[str],
) -> SensorFile:
    """Return the sensor that a training and the observables of its recording describe.

    Args:
        state: The calibration; its terms read the measured distance.
        recording: What it was trained on, for the modulation frequency.
        observed: The same recording, read for its observables.
        curve: Its noise.
        missing: Its missing pixels.
        title: What the camera is, in one line.
        measured_from: What was measured, and what is not known, a sentence each.

    Raises:
        ConfigError: The calibration has a residual network, which the file cannot hold.
    """
    if state.residual is not None:
        raise ConfigError(
            "sensor.yaml holds no residual network; train without one, or with more terms."
        )
    terms = state.error_model.with_columns().terms
    section = ErrorSection(reads="measured_distance", terms=terms)
    effects = []
    if state.fixed_pattern is not None:
        height, width = state.fixed_pattern.shape
        values = [[round(v, 6) for v in row] for row in state.fixed_pattern.tolist()]
        effects = [{"name": "fixed_pattern", "height": height, "width": width, "values_m": values}]
    return SensorFile(
        format="tofcorr-sensor",
        version=1,
        title=title,
        measured_from=tuple(measured_from),
        camera=SensorCamera.of(state.camera),
        depth_kind=state.depth_kind,
        modulation_frequency_hz=recording.modulation_frequency,
        error=section_of(state.model().error, section),
        effects=tuple(effects),
        noise=noise_section(curve, pattern_is_an_effect=bool(effects)),
        dropouts=dropout_section(missing, observed),
        light=light_section(observed),
        validity=validity_of(state.domain),
    )
