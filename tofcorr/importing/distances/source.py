"""Distances and poses of one sensor before one or several walls."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.distances.table import DistanceTable, read_distances
from tofcorr.importing.poses.read import read_poses
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import RefusedViewError
from tofcorr.importing.source import DepthImage

_DISTANCES = ("measurements.csv", "distances.csv", "measurements.txt", "distances.txt")
_POSES = ("transforms.csv", "poses.csv", "poses.txt", "poses.npy", "transforms.txt")


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceSource:
    """Readings as images of a few pixels; a `tofcorr.importing.source.DepthSource`.

    Attributes:
        origin: The files or folders.
        names: Wall and number of each reading.
        times: None: rows and poses belong together in their order.
        camera: The sensor's zones as pixels.
        track: Poses of the tool, in the same order.
        targets: The wall of each reading, shape (N,).
        warnings: Sentences for people.
    """

    origin: str
    names: Sequence[str]
    times: None
    camera: CameraIntrinsics
    track: PoseTrack
    targets: np.ndarray
    warnings: list[str]
    _metres: np.ndarray

    def read(self, number: int) -> DepthImage:
        """Return the reading at one pose.

        Raises:
            RefusedViewError: No zone has a return.
        """
        image = self._metres[number].astype(np.float32)
        if not np.isfinite(image).any():
            raise RefusedViewError("no zone has a return")
        return DepthImage(image)


def open_distances(
    sources: Sequence[Path],
    camera: CameraIntrinsics,
    *,
    poses: Sequence[Path] = (),
    pose_format: str | None = None,
    walls: Sequence[str] = (),
    unit_mm: float | None = None,
) -> DistanceSource:
    """Read distances before one or several walls.

    Args:
        sources: For each wall a file of distances, or a folder with one and a file of poses.
        camera: The sensor's zones as pixels.
        poses: For each wall a file of poses; none where folders hold them.
        pose_format: Of `tofcorr.importing.poses.read.POSE_FORMATS`; None: told from the content.
        walls: What each wall is called; none: as its file or folder.
        unit_mm: Millimetres per count; None: inferred.

    Raises:
        CalibrationDataError: A file is missing or damaged, or rows and poses are not as many.
        ConfigError: There are not as many poses or names as sources.
    """
    for what, given in (("--poses", poses), ("--wall", walls)):
        if given and len(given) != len(sources):
            raise ConfigError(
                f"{what} is needed once for each of {len(sources)} sources, got {len(given)}."
            )
    names = [*walls] or [source.stem for source in sources]
    if len(set(names)) < len(names):
        raise ConfigError(f"Two walls have one name: {', '.join(names)}. Name them with --wall.")
    zones = (camera.width, camera.height)
    tables, tracks = [], []
    for place, source in enumerate(sources):
        table = read_distances(_file_in(source, _DISTANCES, "distances"), zones, unit_mm)
        given = poses[place] if poses else _file_in(source, _POSES, "poses")
        track = read_poses(given, pose_format)
        if len(track) != len(table.metres):
            raise CalibrationDataError(
                f"{given}: {len(track)} poses beside {len(table.metres)} rows of distances; "
                "expected one row for each pose."
            )
        tables.append(table)
        tracks.append(track.world_from_tool)
    origin = ", ".join(map(str, sources)) if len(sources) < 3 else f"{sources[0]}, ..."
    return DistanceSource(
        origin=origin,
        names=[
            f"{n} {k}" for n, t in zip(names, tables, strict=True) for k in range(len(t.metres))
        ],
        times=None,
        camera=camera,
        track=PoseTrack.checked(np.concatenate(tracks), origin),
        targets=np.repeat(names, [len(table.metres) for table in tables]),
        warnings=_warnings(tables, zones, unit_mm),
        _metres=np.concatenate([table.metres for table in tables]),
    )


def _file_in(source: Path, names: Sequence[str], what: str) -> Path:
    """Return the file itself, or the one of these names in a folder."""
    if not source.is_dir():
        if what == "poses":
            raise ConfigError(f"{source} is a file: name its poses with --poses.")
        return source
    found = next((source / name for name in names if (source / name).exists()), None)
    if found is None:
        raise CalibrationDataError(
            f"{source}: no file of {what}; expected one of {', '.join(names)}."
        )
    return found


def _warnings(
    tables: Sequence[DistanceTable], zones: tuple[int, int], unit_mm: float | None
) -> list[str]:
    sentences = []
    units = {table.unit_mm for table in tables}
    if len(units) > 1:
        raise CalibrationDataError(
            "The sources seem to have different units: typical numbers are "
            f"{', '.join(f'{table.typical:g}' for table in tables)}. State --depth-unit-mm."
        )
    if unit_mm is None:
        (unit,) = units
        word = "millimetres" if unit == 1.0 else "metres"
        sentences.append(
            f"Distances are typically {tables[0].typical:g} and read as {word}; state "
            f"--depth-unit-mm {unit:g} if that is right."
        )
    if zones == (1, 1):
        sentences.append(
            "One pixel: its ray is the optical axis by definition. The ray's place and direction "
            "on the tool can be found; a turn about the ray cannot."
        )
    return sentences
