"""`tofcorr.rig`: calibrate several cameras of one robot together, and the robot's own errors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

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
from tofcorr.geometry.arm import Arm
from tofcorr.geometry.camera import FrameNames
from tofcorr.options import dump_yaml, resolve_options
from tofcorr.pixels.dataset import (
    Dataset,
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
            found = {key: self.report[key] for key in ("transforms", "walls", "joints")}
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
        number = len(self.report["transforms"]) + len(self.report["joints"])
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
            *at_most(max(others, 3), _joint_lines(report["joints"])),
        ]


def rig(
    recordings: Recordings,
    config: Config = "ea",
    *,
    urdf: Path | str | None = None,
    out: Path | str | None = None,
    force: bool = False,
) -> RigResult:
    """Fit the error models and hand-eye transforms of several cameras of one robot together.

    Walls in unknown places are those of all cameras that see them. Recordings belong to one camera
    if their `frames` in recording.yaml give it the same name. A recording whose camera has the
    usual name, `camera`, is of a camera called as its folder.

    Args:
        recordings: Folders, or opened recordings.
        config: As for `tofcorr.train`, for every camera; without a residual network.
        urdf: Description of the robot. The offsets of its joints are estimated as well; the
            recordings need the columns `joint_1`, `joint_2`, ...
        out: Folder with a run folder for each camera, written whole or not at all; nothing may be
            there yet. None writes nothing; `RigResult.save` does later.
        force: Fit whatever the recordings look like, and write correctors whatever the verdicts.

    Raises:
        ConfigError: The configuration is wrong, or the URDF is not that of the recordings.
        CalibrationDataError: A camera cannot be calibrated, no robot moves it, or `out` exists.
    """
    options = resolve_options(TrainingOptions, config)
    if options.residual is not None:
        raise ConfigError(
            "rig: expected `residual: null`: a network is fitted to one camera alone."
        )
    if out is not None:
        refuse_existing(Path(out))
    with timed_stages("rig", written=out is not None) as (stage, seconds):
        with stage("read"):
            named = _by_camera(recordings)
            everything = [one for data in named.values() for one in data.recordings]
            arm = None if urdf is None else _arm(urdf, next(iter(named.values())))
            planes = resolved_planes(options.planes, everything)
            options = options.model_copy(update={"planes": planes})
        with stage("inspect"):
            seen = {name: inspected(data, options, force=force) for name, data in named.items()}
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
    found = {name: Dataset(tuple(own)) for name, own in named.items()}
    for data in found.values():
        if not data.moves:
            said = "no robot moves this camera, so that nothing relates it to others"
            raise CalibrationDataError(
                f"{data.first.path}: {said}. Calibrate it by `tofcorr train`."
            )
    return found


def _arm(urdf: Path | str, data: Dataset) -> Arm:
    """Return the robot's chain between the links that the recording names."""
    frames = data.first.frame_names
    base, tip = (frames.tool, frames.world) if frames.eye_to_hand else (frames.world, frames.tool)
    return Arm.read(urdf, base, tip)


def _report(joint: JointFit, cameras: Mapping[str, TrainingResult]) -> dict[str, Any]:
    """Return the content of rig.json: millimetres and degrees, intervals of 95 %."""
    freedom, names = joint.covariance.degrees_of_freedom, list(cameras)
    quantile = student_quantile(39 / 40, freedom)
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
        "joints": _joints(joint, quantile),
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


def _joints(joint: JointFit, quantile: float) -> list[dict[str, Any]]:
    """Return the offset of each joint, with its interval, or what it cannot be told from."""
    found, place = list[dict[str, Any]](), joint.together.places()[-1]
    variances, offsets = joint.covariance.matrix.diagonal()[place], joint.together.offsets
    for number, name in enumerate(() if joint.arm is None else joint.arm.names):
        assert joint.arm is not None
        unit, per_unit = ("deg", math.degrees(1)) if joint.arm.turns[number] else ("mm", 1e3)
        one: dict[str, Any] = {"joint": name, "unit": unit, "offset": 0.0, "ci95": None}
        one["same_as"] = joint.undetermined.get(number)
        if number in joint.chosen:
            k = joint.chosen.index(number)
            half = quantile * math.sqrt(max(float(variances[k]), 0.0))
            one |= {"offset": per_unit * float(offsets[k]), "ci95": per_unit * half}
        found.append(one)
    return found


def _transform_line(one: Mapping[str, Any]) -> str:
    pairs = zip("xyz", one["translation_mm"], one["translation_ci95_mm"], strict=True)
    place = ", ".join(f"{axis} {value:.2f} ± {half:.2f}" for axis, value, half in pairs)
    turn = max(one["rotation_ci95_deg"])
    return f"{one['child']} in {one['parent']}, mm: {place}; turn ± {turn:.3f} deg (95 %)"


def _joint_lines(joints: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the offsets that are determined in one line, and each other in a sentence."""
    known = [
        f"{one['joint']} {one['offset']:+.3f} ± {one['ci95']:.3f} {one['unit']}"
        for one in joints
        if one["ci95"] is not None
    ]
    lines = [f"joint offsets (95 %): {', '.join(known)}"] if known else []
    for one in joints:
        if one["ci95"] is None:
            same = one["same_as"]
            why = f"is the same as {same}" if same else "is not determined: the poses hardly use it"
            lines.append(f"The offset of {one['joint']} {why}; 0 is used.")
    return lines
