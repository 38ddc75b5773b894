"""`tofcorr.rig`: calibrate cameras of one robot or cell together, and the robot's own errors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.export.urdf import corrected_description
from tofcorr.data.recording import Recording
from tofcorr.digits import aligned, at_most
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.robust import student_quantile
from tofcorr.estimation.uncertainty import worst_axes
from tofcorr.files import refuse_existing, staged_folder, write_json
from tofcorr.fit.joint import JointFit, fit_together
from tofcorr.fit.problem import Problem
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm
from tofcorr.geometry.camera import FrameNames
from tofcorr.options import dump_yaml, resolve_options
from tofcorr.pixels.dataset import (
    Dataset,
    HandEyeOptions,
    PlaneChoice,
    Recordings,
    opened,
    resolved_planes,
)
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.training.calibration import Calibration, TrainingOptions, halves
from tofcorr.training.judgement import VERDICTS
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.report import training_report
from tofcorr.training.run import Config, TrainingResult, inspected, timed_stages
from tofcorr.version import __version__

ROBOT_FILE = "robot.urdf"
"""The robot's description with the offsets found, in the folder of a rig."""
RIG_FILE = "rig.json"
"""What was found of several cameras together, in the folder that holds their runs."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RigResult:
    """Several cameras that were calibrated together.

    Attributes:
        report: The content of rig.json.
        cameras: The training of each camera, by its name.
        fit: The joint fit.
        robot: Description of the robot with the offsets of its joints; None: none was given.
    """

    report: Mapping[str, Any]
    cameras: Mapping[str, TrainingResult]
    fit: JointFit
    robot: str | None = None

    def save(self, folder: Path | str) -> None:
        """Write a run folder for each camera, rig.json, rig.yaml and robot.urdf.

        Raises:
            CalibrationDataError: Something is there already, or it cannot be written.
        """
        with staged_folder(folder) as staged:
            for name, result in self.cameras.items():
                (staged / name).mkdir()
                result.write_into(staged / name)
            write_json(staged / RIG_FILE, self.report)
            found = {key: self.report[key] for key in ("transforms", "walls", "joints", "lengths")}
            if self.robot is not None:
                (staged / ROBOT_FILE).write_text(self.robot, encoding="utf-8")
            (staged / "rig.yaml").write_text(dump_yaml(found), encoding="utf-8")
        for name, result in self.cameras.items():
            result.show_in(Path(folder) / name)

    def __repr__(self) -> str:
        """Return verdict, cameras, transforms, joints and warnings: 12 lines at most."""
        return "\n".join([*self._first(4, 2), *at_most(2, self.report["warnings"])])

    @property
    def details(self) -> str:
        """All that was found together, and all that each camera's training says of itself."""
        number = sum(len(self.report[key]) for key in ("transforms", "joints", "lengths"))
        texts = [f"{name}\n{one.details}" for name, one in self.cameras.items()]
        return "\n".join(
            [*self._first(len(self.cameras) + 1, number), *self.report["warnings"], *texts]
        )

    def _first(self, cameras: int, others: int) -> list[str]:
        """Return the verdict, the rows of some cameras, and some transforms and joints."""
        report = self.report
        rows = [["camera", "verdict", "held out RMS, mm", "hand-eye known to, mm", "deg"]]
        for name, one in report["cameras"].items():
            error, known = one["held_out_rms_mm"], (f"{x:.2f}" for x in one["hand_eye_ci95_mm_deg"])
            rows.append([name, one["verdict"], "-" if error is None else f"{error:.2f}", *known])
        transforms = [_transform_line(one) for one in report["transforms"]]
        return [
            f"Verdict: {report['verdict']}. {report['reason']}",
            *at_most(cameras, aligned(rows)),
            *at_most(others, transforms),
            *at_most(max(others, 3), _offset_lines(report)),
        ]


def rig(
    recordings: Recordings,
    config: Config = "ea",
    *,
    urdf: Path | str | None = None,
    length_tolerance_mm: float | None = None,
    out: Path | str | None = None,
    force: bool = False,
) -> RigResult:
    """Fit the error models and hand-eye transforms of cameras of one robot, or cell, together.

    Walls in unknown places are those of all cameras that see them. Cameras that stand still are
    related by a target that is moved by hand, see `around_cell`. Recordings belong to one camera
    if their `frames` in recording.yaml give it the same name. A recording whose camera has the
    usual name, `camera`, is of a camera called as its folder.

    Args:
        recordings: Folders, or opened recordings.
        config: As for `tofcorr.train`, for every camera; without a residual network.
        urdf: Description of the robot. The offsets of its joints are estimated as well; the
            recordings need the columns `joint_1`, `joint_2`, ...
        length_tolerance_mm: Standard deviation that the robot's maker states of lengths of links;
            they are estimated as well. None: those of the URDF are right.
        out: Folder with a run folder for each camera, written whole or not at all; nothing may be
            there yet. None writes nothing; `RigResult.save` does later.
        force: Fit whatever the recordings look like, and write correctors whatever the verdicts.

    Raises:
        ConfigError: The configuration is wrong, or the URDF is not that of the recordings.
        CalibrationDataError: A camera cannot be calibrated, nothing relates it, or `out` exists.
    """
    options = resolve_options(TrainingOptions, config)
    if options.residual is not None:
        raise ConfigError(
            "rig: expected `residual: null`: a network is fitted to one camera alone."
        )
    if length_tolerance_mm is not None and (urdf is None or not length_tolerance_mm > 0):
        said = f"a positive number, and the robot's URDF, got {length_tolerance_mm:g}, {urdf}"
        raise ConfigError(f"rig: a tolerance of lengths needs {said}.")
    if out is not None:
        refuse_existing(Path(out))
    with timed_stages("rig", written=out is not None) as (stage, seconds):
        with stage("read"):
            named = _by_camera(recordings)
            still = not all(data.moves for data in named.values())
            named = around_cell(named, options.planes) if still else named
            everything = [one for data in named.values() for one in data.recordings]
            tolerance = math.inf if length_tolerance_mm is None else length_tolerance_mm / 1000
            arm = None if urdf is None else _arm(urdf, next(iter(named.values())), tolerance)
            planes = resolved_planes(options.planes, everything)
            options = options.model_copy(update={"planes": planes})
            fixed = {"hand_eye": HandEyeOptions(estimate="no")} if still else {}
            first = options.model_copy(update=fixed)
        with stage("inspect"):
            seen = {
                name: inspected(data, options if k else first, force=force)
                for k, (name, data) in enumerate(named.items())
            }
        with stage("fit"):
            problems, monitors = list[Problem](), {name: RunMonitor() for name in seen}
            for name, (data, own, _, left_out) in seen.items():
                frames, _ = halves(data, own, left_out)
                lattice, watch = lattice_of(data, frames), monitors[name].iteration
                domain = covered_domain(data, frames, lattice)
                problems.append(Problem(data, frames, own, domain, lattice, watch))
            joint = fit_together(problems, arm)
        with stage("report"):
            cameras = dict[str, TrainingResult]()
            each = zip(seen.items(), joint.fits, joint.problems, strict=True)
            for (name, (_, own, inspection, left_out)), found, problem in each:
                made = Calibration(problem.dataset, own, left_out=left_out, found=found)
                cameras[name] = TrainingResult(
                    report=training_report(made, own, inspection) | {"seconds": seconds},
                    calibration=made,
                    options=own,
                    monitor=monitors[name],
                    force=force,
                )
            robot = None
            if urdf is not None and arm is not None:
                names = [arm.names[k] for k in joint.chosen]
                found = dict(zip(names, joint.together.offsets.tolist(), strict=True))
                robot = corrected_description(urdf, arm, found)
            report = _report(joint, cameras)
            if options.runtime.second_bounces is not None:
                said = "Warning: second bounces were in the frames of this fit, though correctors "
                said += "remove them; `tofcorr train` fits one camera's error without them."
                report["warnings"].insert(0, said)
            result = RigResult(report=report, cameras=cameras, fit=joint, robot=robot)
        if out is not None:
            with stage("write"):
                result.save(out)
    return result


def _by_camera(recordings: Recordings) -> dict[str, Dataset]:
    """Return the recordings of each camera, in the order of the first of each."""
    named = dict[str, list[Recording]]()
    for one in opened(recordings):
        name = one.frame_names.camera.strip("/").replace("/", "_")
        if name == FrameNames().camera:
            name = one.path.resolve().name
            if name in named:
                said = f"{one.path}: another recording is of a camera called '{name}' too"
                raise CalibrationDataError(
                    f"{said}. Name them: `frames: {{camera: NAME}}` in recording.yaml."
                )
        named.setdefault(name, []).append(one)
    return {name: Dataset(tuple(own)) for name, own in named.items()}


def around_cell(named: Mapping[str, Dataset], planes: PlaneChoice = "auto") -> dict[str, Dataset]:
    """Return recordings of cameras that stand still as those of one tool before a wall.

    While a target is moved by hand, a camera that stands still sees what one sees that moves before
    a wall. The planes that the first camera saw say how; it is the tool. What cameras saw at one
    station (`pose_id`), they saw from one pose of the tool.

    Raises:
        CalibrationDataError: There is one camera, some move, stations have no names, the first
            camera lacks one of them, or its planes were not measured.
    """
    first = next(iter(named.values()))
    moving = next((data for data in named.values() if data.moves), None)
    if moving or len(named) < 2:
        said = "a camera that stands still goes with others that do, or alone with `tofcorr train`"
        raise CalibrationDataError(f"{(moving or first).first.path}: {said}.")
    if resolved_planes(planes, first.recordings) == "unknown":
        said = "the first camera's planes were not measured: errors of depth and places look alike"
        raise CalibrationDataError(f"{first.first.path}: {said}. Give another camera first.")
    known = first.plane_covariance()
    poses = se3.inverse(se3.world_from_plane(first.column("normal_world"), first.column("offset")))
    places, placed = dict[str, int](), dict[str, Dataset]()
    for name, data in named.items():
        data.require("pose_id", "a fit of cameras that stand still")
        stations = [station for one in data.recordings for station in one.frames.pose_id]
        places = places or {station: number for number, station in enumerate(stations)}
        if lone := sorted({*stations} - {*places}):
            said = f"{first.first.path} has no frame of pose_id '{lone[0]}', whose plane is needed"
            raise CalibrationDataError(f"{data.first.path}: {said}. Record it there too.")
        at = [places[station] for station in stations]
        pose = poses[at]
        columns = {
            "world_from_tool": pose,
            "normal_world": pose.new_tensor([0, 0, 1]).expand(len(at), 3),
            "offset": pose.new_zeros(len(at)),
        }
        if known is not None:
            columns["plane_covariance"] = se3.inverse(pose).mT @ known[at] @ se3.inverse(pose)
        recordings = [
            replace(
                one,
                planes="recorded",
                frames=replace(one.frames, plane_covariance=None),
                tool_from_camera=np.eye(4) if data is first else one.tool_from_camera,
                frame_names=one.frame_names.model_copy(update={"tool": next(iter(named))}),
            )
            for one in data.recordings
        ]
        numbers = {key: value.numpy() for key, value in columns.items()}
        placed[name] = Dataset(tuple(recordings)).with_columns(**numbers)
    return placed


def _arm(urdf: Path | str, data: Dataset, tolerance: float) -> Arm:
    """Return the robot's chain between the links that the recording names."""
    frames = data.first.frame_names
    base, tip = (frames.tool, frames.world) if frames.eye_to_hand else (frames.world, frames.tool)
    return Arm.read(urdf, base, tip, tolerance)


def _report(joint: JointFit, cameras: Mapping[str, TrainingResult]) -> dict[str, Any]:
    """Return the content of rig.json: millimetres and degrees, intervals of 95 %."""
    names = list(cameras)
    quantile = student_quantile(39 / 40, joint.covariance.degrees_of_freedom)
    transforms = [
        _transform(joint, names, pair, quantile) for pair in combinations(range(len(names)), 2)
    ]
    reports = {name: one.report for name, one in cameras.items()}
    worst = min(names, key=lambda name: VERDICTS.index(reports[name]["verdict"]))
    verdict, reason = reports[worst]["verdict"], f"{worst}: {reports[worst]['reason']}"
    if verdict == VERDICTS[-1] and transforms:
        loosest = max(transforms, key=lambda one: one["known_to_mm_deg"][0])
        known = "{:.2f} mm and {:.3f} deg".format(*loosest["known_to_mm_deg"])
        reason = (
            f"{loosest['child']} is known in {loosest['parent']} to {known} (95 %, worst axis)."
        )
    walls, warnings = _walls(joint, names)
    joints, lengths = _offsets(joint, quantile)
    warnings += [f"Warning, {name}: {text}" for name in names for text in reports[name]["warnings"]]
    return {
        "format": "tofcorr-rig",
        "version": 1,
        "tofcorr": __version__,
        "verdict": verdict,
        "reason": reason,
        "cameras": {
            name: {
                "run": name,
                "recordings": one["recordings"],
                "verdict": one["verdict"],
                "reason": one["reason"],
                "held_out_rms_mm": one["error_mm"]["after"]["test"]["rms"],
                "hand_eye": one["hand_eye"],
                "hand_eye_ci95_mm_deg": _in_mm_deg(fit.hand_eye_covariance, quantile),
            }
            for (name, one), fit in zip(reports.items(), joint.fits, strict=True)
        },
        "transforms": transforms,
        "walls": walls,
        "joints": joints,
        "lengths": lengths,
        "warnings": warnings,
    }


def _in_mm_deg(covariance: Tensor, quantile: float) -> list[float]:
    """Return the half-widths along the worst axes: translation, millimetres; rotation, degrees."""
    shift, turn = worst_axes(covariance)
    return [quantile * 1e3 * shift, quantile * math.degrees(turn)]


def _transform(
    joint: JointFit, names: list[str], pair: tuple[int, int], quantile: float
) -> dict[str, Any]:
    found, covariance = joint.between(*pair)
    turn = torch.block_diag(found[:3, :3], found[:3, :3])
    units = torch.tensor([1e3] * 3 + [math.degrees(1)] * 3, dtype=torch.float64)
    along = units[:, None] * (turn @ covariance @ turn.T) * units
    half = quantile * along.diagonal().clamp(min=0).sqrt()
    return {
        "parent": names[pair[0]],
        "child": names[pair[1]],
        "parent_from_child": found.tolist(),
        "translation_mm": (1e3 * found[:3, 3]).tolist(),
        "translation_ci95_mm": half[:3].tolist(),
        "rotation_ci95_deg": half[3:].tolist(),
        "covariance_mm_deg": along.tolist(),
        "known_to_mm_deg": _in_mm_deg(covariance, quantile),
    }


def _walls(joint: JointFit, names: list[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the walls found, with the cameras that see each; and what a user must know of them."""
    planes, shared = joint.together.planes, joint.shared
    if planes is None or shared is None:
        return [], []
    walls = list[dict[str, Any]]()
    for k, (normal, offset) in enumerate(zip(planes.normal_world, planes.offset, strict=True)):
        seen = [name for name, own in zip(names, shared, strict=True) if k in own.tolist()]
        walls.append({"normal_world": normal.tolist(), "offset_m": float(offset), "cameras": seen})
    alone = [n for n in names if all(w["cameras"] == [n] for w in walls if n in w["cameras"])]
    said = "shares no wall with another camera: the others do not help it."
    return walls, [f"Warning: {name} {said}" for name in alone if len(names) > 1]


def _offsets(joint: JointFit, quantile: float) -> tuple[list[dict[str, Any]], ...]:
    """Return errors of joints, and of lengths: an interval, or what each cannot be told from."""
    found, arm = (list[dict[str, Any]](), list[dict[str, Any]]()), joint.arm
    variances = joint.covariance.matrix.diagonal()[joint.together.places()[-1]].clamp(min=0)
    for number, name in enumerate(() if arm is None else arm.names):
        assert arm is not None
        unit, per_unit = ("deg", math.degrees(1)) if arm.turns[number] else ("mm", 1e3)
        one = {"joint": name, "unit": unit, "offset": 0.0, "ci95": None, "determined": False}
        one["same_as"] = joint.undetermined.get(number)
        if number in joint.chosen:
            k = joint.chosen.index(number)
            offset, spread = (
                per_unit * float(x[k]) for x in (joint.together.offsets, variances.sqrt())
            )
            one |= {"offset": offset, "ci95": quantile * spread}
            # Else more than half of the variance is the tolerance's.
            one["determined"] = 2 * float(variances[k]) < float(arm.tolerance[number]) ** 2
        found[int(arm.is_length[number])].append(one)
    return found


def _transform_line(one: Mapping[str, Any]) -> str:
    pairs = zip("xyz", one["translation_mm"], one["translation_ci95_mm"], strict=True)
    place = ", ".join(f"{axis} {value:.2f} ± {half:.2f}" for axis, value, half in pairs)
    turn = max(one["rotation_ci95_deg"])
    return f"{one['child']} in {one['parent']}, mm: {place}; turn ± {turn:.3f} deg (95 %)"


def _offset_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the offsets that are determined in a line for each kind, and what of the others."""
    lines = list[str]()
    for what, key in (("joint offsets (95 %)", "joints"), ("errors of lengths (95 %)", "lengths")):
        for head, determined in ((what, True), ("hardly better known than the tolerance", False)):
            values = [
                f"{one['joint']} {one['offset']:+.3f} ± {one['ci95']:.3f} {one['unit']}"
                for one in report[key]
                if one["ci95"] is not None and one["determined"] is determined
            ]
            lines += [f"{head}: {', '.join(values)}"] if values else []
    for one in (*report["joints"], *report["lengths"]):
        if one["ci95"] is None:
            unseen = "is not determined: the images hardly show it"
            why = f"is the same as {one['same_as']}" if one["same_as"] else unseen
            lines.append(f"The offset of {one['joint']} {why}; 0 is used.")
    return lines
