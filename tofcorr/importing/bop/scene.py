"""A rendered or recorded scene whose poses are the camera's own."""

from pathlib import Path

import numpy as np

from tofcorr.errors import ConfigError
from tofcorr.importing.bop.hdf5 import open_hdf5
from tofcorr.importing.bop.scene_camera import FILE_NAME, read_scene_camera
from tofcorr.importing.frames.source import open_folder
from tofcorr.importing.images.coding import DepthCoding
from tofcorr.importing.intrinsics_file import read_named_intrinsics
from tofcorr.importing.posed.drive import Drive
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.posed.source import import_posed
from tofcorr.importing.report import ImportReport
from tofcorr.importing.sieve import Progress, no_progress

_TOOL_IS_CAMERA = np.eye(4)


def import_scene(
    scene: Path,
    out: Path,
    options: PosedOptions,
    *,
    amplitude_pattern: str | None = None,
    intrinsics: str | None = None,
    progress: Progress = no_progress,
) -> ImportReport:
    """Turn a scene in BOP's layout, or a folder of HDF5 files, into a recording.

    Args:
        scene: The folder.
        out: The recording to write; it must not exist yet.
        options: How to choose images and look for walls.
        amplitude_pattern: Names of amplitude images; BOP alone.
        intrinsics: A file or a shipped name; HDF5 alone.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: The scene lacks something, such as poses; the message says what.
        ConfigError: An option belongs to the other layout.
    """
    hdf5 = not (scene / FILE_NAME).exists() and any(scene.glob("*.hdf5"))
    if hdf5:
        if amplitude_pattern is not None:
            raise ConfigError("--amplitude is for BOP's layout; HDF5 scenes have no amplitudes.")
        given = None
        if intrinsics is not None:
            given = read_named_intrinsics(intrinsics)
        source = open_hdf5(scene, given)
        options = options.model_copy(update={"depth_kind": source.depth_kind})
        track, refused = source.track, []
    else:
        if intrinsics is not None:
            raise ConfigError(f"--intrinsics is for HDF5; a BOP scene states them in {FILE_NAME}.")
        camera = read_scene_camera(scene / FILE_NAME)
        coding = DepthCoding(unit_mm=camera.unit_mm)
        source = open_folder(
            scene, "depth/*.png", camera.intrinsics, coding, amplitude_pattern=amplitude_pattern
        )
        track, refused = camera.track, source.refused
    drive = Drive(source=source, track=track, refused=refused, tool_from_camera=_TOOL_IS_CAMERA)
    return import_posed(drive, out, options, progress)
