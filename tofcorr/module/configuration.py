"""The forms in which a user may say which terms a correction has, and on which ranges."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.registry import TermOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, Recordings, opened
from tofcorr.pixels.domain import covered_domain
from tofcorr.training.options import TrainingOptions

Terms = (
    str
    | Path
    | Mapping[str, Any]
    | TrainingOptions
    | ErrorModelOptions
    | Sequence[TermOptions | Mapping[str, Any]]
)
"""A shipped configuration's name or file, whole options, or the list of terms."""

# Ranges that scale the variables of a module until a fit or the user gives others. Metres and
# camera units; what today's time-of-flight cameras commonly measure indoors. Set by hand.
_USUAL_DISTANCES = Interval(0.3, 5.0)
_USUAL_AMPLITUDES = Interval(1.0, 1000.0)
_USUAL_NORMALISED = Interval(1.0, 1000.0)
# Lowest, highest and mean: an hour, 0.1 to 2 ms, two ranges of temperature, some background light.
_USUAL_CONDITIONS = {
    "timestamp": (0.0, 3600.0, 1800.0),
    "integration_time": (1e-4, 2e-3, 1e-3),
    "room_temperature": (15.0, 30.0, 22.0),
    "body_temperature": (20.0, 60.0, 40.0),
    "ambient": (0.0, 1.0, 0.5),
}


def resolve_terms(terms: Terms) -> TrainingOptions:
    """Return whole options, with the defaults of a training where only terms are given.

    Raises:
        ConfigError: There is no such configuration, or a value is not allowed.
    """
    if isinstance(terms, ErrorModelOptions):
        return TrainingOptions(name=_name(terms), model=terms)
    if isinstance(terms, Sequence) and not isinstance(terms, str):
        given = [dict(term) if isinstance(term, Mapping) else term.to_mapping() for term in terms]
        model = ErrorModelOptions.from_mapping({"terms": given}, "terms")
        return TrainingOptions(name=_name(model), model=model)
    return resolve_options(TrainingOptions, terms)


def resolve_domain(ranges: Domain | Recordings | None, camera: CameraIntrinsics) -> Domain:
    """Return the ranges given, those of all frames of recordings, or the usual ones.

    Raises:
        CalibrationDataError: The recordings are of another camera, or hold no usable pixel.
        ConfigError: `camera` is something else, such as the recording.
    """
    if not isinstance(camera, CameraIntrinsics):
        raise ConfigError(
            f"camera: expected a tofcorr.CameraIntrinsics, got {type(camera).__name__}. A "
            "recording holds its own: tofcorr.Recording.open(FOLDER).camera."
        )
    if ranges is None:
        return usual_domain(camera)
    if isinstance(ranges, Domain):
        return replace(ranges, height=camera.height, width=camera.width)
    dataset = open_dataset(ranges, camera)
    return covered_domain(dataset, range(dataset.num_frames))


def usual_domain(camera: CameraIntrinsics) -> Domain:
    """Return ranges for a module that is not fitted yet; the modulation frequency is unknown."""
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=_USUAL_DISTANCES,
        amplitude=_USUAL_AMPLITUDES,
        normalised_amplitude=_USUAL_NORMALISED,
        conditions=_USUAL_CONDITIONS,
    )


def open_dataset(recordings: Recordings, camera: CameraIntrinsics) -> Dataset:
    """Open one or several recordings of a camera.

    Raises:
        CalibrationDataError: A recording is broken, or its image size, K or distortion differ.
    """
    dataset = Dataset(opened(recordings))
    found = dataset.first.camera
    if found != camera:
        raise CalibrationDataError(
            f"{dataset.first.path}: is of the camera {found}, the module was built for {camera}. "
            "Build DepthCorrection(recording.camera)."
        )
    return dataset


def _name(model: ErrorModelOptions) -> str:
    return " + ".join(term.kind for term in model.terms) or "constant"
