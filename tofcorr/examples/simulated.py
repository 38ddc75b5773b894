"""What the examples hold, drawn by the sensor simulator: one function an example."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from tofcorr.examples import files
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions, z_depth_from_radial_distance
from tofcorr.options import dump_yaml, resolve_options
from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.robot import draw_plan
from tofcorr.simulation.simulator import simulate, take_frames

_ROBOT = (
    "scene.plane={normal: [-1, 0, 0], offset_m: 1.6}",
    "robot.roll_deg=90",
    "scene.subsamples=2",
    "hand_eye.rotation_deg=[3, -4, 60]",
    "sensor.delays.constant_mm=10",
)
"""What differs from the demo: a wall before the robot, a camera mounted askew and less wrong."""
_WALL = (*_ROBOT, "shots=[{target: checkerboard, poses: 30}]")
_BOARD = (
    *_ROBOT,
    "shots=[{target: board, poses: 20}]",
    "scene.targets.board={pattern: checkerboard, square_mm: 40, squares: [6, 8]}",
    "camera={width: 224, height: 172, K: [[210, 0, 111.2], [0, 210, 86.5], [0, 0, 1]], "
    "distortion: [-0.08, 0.02, 0.0005, -0.0004]}",
    "robot.distance_m=[0.45, 0.8]",
    "robot.aim_spread_m=0.03",
    "robot.tilt_deg=30",
)
_SENSORS = {
    "": (
        "camera={width: 1, height: 1, K: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], distortion: []}",
        "robot.distance_m=[0.15, 0.7]",
        "sensor.light.electrons_at_1m=2.5e+5",
    ),
    "_zones": (
        "camera={width: 8, height: 8, K: [[9.66, 0, 3.5], [0, 9.66, 3.5], [0, 0, 1]], "
        "distortion: []}",
        "robot.distance_m=[0.3, 1.0]",
    ),
}
_WALLS = {
    "north": "scene.plane={normal: [-1, 0, 0], offset_m: 1.2}",
    "east": "scene.plane={normal: [0, 1, 0], offset_m: 1.1}",
}
_ARM = (
    "scene.plane={normal: [-1, 0, 0], offset_m: 1.3}",
    "scene.subsamples=2",
    "robot.distance_m=[0.5, 1.1]",
    "robot.arm={offsets_deg: [0.15, -0.2, 0.3, -0.1, 0.25, 0.2]}",
)
_READINGS = 8
_REPEATED = (
    "shots=[{target: white, poses: 20}]",
    "robot.repeat_poses=20",
    f"robot.repeat_frames={_READINGS}",
)
"""Each of 20 poses several times, without moving."""
_START = 1_700_000_000.0
"""Stamp of the first image, seconds since 1970."""


def bag(
    folder: Path,
    seed: int,
    *,
    cycle: float = 1.2,
    poses_a_second: int = 20,
    image_step: float = 0.3,
) -> None:
    """Write `stops`, a ROS 2 bag of a robot that stops at 30 poses, and its moves between them.

    Args:
        folder: Where to write it.
        seed: Of all random draws.
        cycle: Time from stop to stop, seconds.
        poses_a_second: How many the robot reports.
        image_step: Time from image to image, seconds. They lie between the poses: the camera has a
            clock of its own.
    """
    from tofcorr.examples.bags import write_bag

    options, plan, generator = _planned("demo", _WALL, seed)
    recorded, reached = _poses(plan)
    pose_times = np.arange(0, cycle * len(plan), 1 / poses_a_second)
    image_times = np.arange(image_step / 2, pose_times[-1], image_step)
    way = _on_the_way(reached, image_times / cycle)
    taken = _taken(
        options, (replace(plan[0], world_from_tool=pose) for pose in way), image_times, generator
    )
    poses = _on_the_way(recorded, pose_times / cycle).numpy()
    write_bag(
        replace(taken, pose_times=_START + pose_times, world_from_tool=poses), folder / "stops"
    )
    _write_truth(options, folder)


def images(folder: Path, seed: int) -> None:
    """Write `depth/STAMP.png`, `ir/STAMP.png`, `poses.txt` and `camera.yaml` of 30 poses."""
    _write_stops(folder, seed, _WALL)


def board(folder: Path, seed: int) -> None:
    """Write the same of a board of 5 x 7 inner corners."""
    _write_stops(folder, seed, _BOARD)


def distances(folder: Path, seed: int) -> None:
    """Write a folder of each wall for a sensor of one ray, and of each for one of 8 x 8 zones."""
    for kind, sensor in _SENSORS.items():
        for number, (wall, plane) in enumerate(_WALLS.items()):
            changes = (*_ROBOT, plane, *sensor, *_REPEATED)
            options, plan, generator = _planned("demo", changes, seed + number)
            read = _taken(options, plan, _times(plan), generator)
            own = folder / f"{wall}{kind}"
            own.mkdir()
            rows = read.depth_mm.reshape(len(plan) // _READINGS, -1)
            np.savetxt(own / "measurements.csv", rows, fmt="%d", delimiter=", ")
            files.write_matrices(_poses(plan)[0][::_READINGS].numpy(), own / "transforms.csv")
    _write_truth(_options("demo", _ROBOT, seed), folder)


def recording(folder: Path, seed: int) -> None:
    """Write the recording of the demo."""
    made = simulate(_options("demo", (), seed), folder / "recording").path
    for part in list(made.iterdir()):
        part.rename(folder / part.name)
    made.rmdir()


def arm(folder: Path, seed: int) -> None:
    """Write `wall`, a recording of an arm whose joints have offsets, and `arm.urdf`."""
    options = _options("demo", _ARM, seed)
    simulate(options, folder / "wall")
    robot = options.robot.arm
    assert robot is not None
    (folder / "arm.urdf").write_text(robot.file.read_text(encoding="utf-8"), encoding="utf-8")
    _write_truth(options, folder)


def simulator(folder: Path, seed: int) -> None:
    """Write `recording` of a camera with an effect, and `depth/NUMBER.npy` of one without errors.

    The depth is along the optical axis, float32, metres, at the recorded poses.
    """
    lacking = ("effects=[{name: integration_time, log_1: 0.008}]",)
    options = _options("diagnosis", lacking, seed)
    made = simulate(options, folder / "recording")
    rays = ray_directions(made.camera)
    (folder / "depth").mkdir()
    truth = np.load(made.path / "truth" / "radial_distance.npy", mmap_mode="r")
    for number, distance in enumerate(truth):
        z = z_depth_from_radial_distance(torch.tensor(distance), rays.float())
        np.save(folder / "depth" / f"{number:04d}.npy", z.numpy())
    _write_truth(options, folder)


def _options(config: str, changes: Iterable[str], seed: int) -> SimulatorOptions:
    return resolve_options(SimulatorOptions, config, (f"seed={seed}", *changes))


def _planned(
    config: str, changes: Iterable[str], seed: int
) -> tuple[SimulatorOptions, list[FrameState], Generator]:
    """Return the options, the frames to take, and the generator that goes on with the noise."""
    options, generator = _options(config, changes, seed), Generator().manual_seed(seed)
    return options, draw_plan(options, generator), generator


def _write_stops(folder: Path, seed: int, changes: Iterable[str]) -> None:
    options, plan, generator = _planned("demo", changes, seed)
    taken = _taken(options, plan, _times(plan), generator)
    files.write_png(taken, folder, [f"{time:.6f}" for time in taken.image_times])
    files.write_tum(taken.pose_times, taken.world_from_tool, folder / "poses.txt")
    files.write_intrinsics(taken, folder / "camera.yaml")
    _write_truth(options, folder)


def _times(plan: Iterable[FrameState]) -> np.ndarray:
    return np.array([float(frame.facts.timestamp[-1]) for frame in plan])


def _poses(plan: Iterable[FrameState]) -> tuple[Tensor, Tensor]:
    """Return the poses that the robot reports, and those that it reached, (F, 4, 4) each."""
    both = [(frame.facts.world_from_tool[-1], frame.world_from_tool) for frame in plan]
    recorded, reached = map(torch.stack, zip(*both, strict=True))
    return recorded, reached


def _taken(
    options: SimulatorOptions,
    frames: Iterable[FrameState],
    times: np.ndarray,
    generator: Generator,
) -> files.Recorded:
    """Take the frames, with their recorded poses."""
    rays, depth, amplitude, poses = ray_directions(options.camera.intrinsics()), [], [], []
    for state in take_frames(options, frames, generator):
        z = 1000 * z_depth_from_radial_distance(state.measured_distance, rays)
        depth.append(z.nan_to_num(0.0).round().numpy().astype(np.uint16))
        amplitude.append(state.measured_amplitude.nan_to_num(0.0).round().numpy().astype(np.uint16))
        poses.append(state.facts.world_from_tool[-1].numpy())
    return files.Recorded(
        depth_mm=np.stack(depth),
        amplitude=np.stack(amplitude),
        image_times=_START + times,
        pose_times=_START + times,
        world_from_tool=np.stack(poses),
        matrix=np.array(options.camera.K),
        distortion=options.camera.distortion,
    )


def _on_the_way(stops: Tensor, times: np.ndarray, dwell: float = 0.6) -> Tensor:
    """Return the poses (T, 4, 4) of a robot that stops at each of (S, 4, 4).

    Args:
        stops: The poses of the stops.
        times: When, in stops since the first.
        dwell: Share of the time that the robot stands still.
    """
    time = torch.from_numpy(times)
    stop = time.long()
    share = ((time - stop - dwell) / (1 - dwell)).clamp(min=0.0)
    following = stops[(stop + 1).clamp(max=len(stops) - 1)]
    move = se3.log(se3.inverse(stops[stop]) @ following)
    # From rest to rest.
    return stops[stop] @ se3.exp((share**2 * (3 - 2 * share))[:, None] * move)


def _write_truth(options: SimulatorOptions, folder: Path) -> None:
    truth: dict[str, object] = {"tool_from_camera": options.hand_eye.tool_from_camera().tolist()}
    if options.robot.arm is not None:
        truth["offsets_deg"] = list(options.robot.arm.offsets_deg)
    (folder / "truth.yaml").write_text(dump_yaml(truth), encoding="utf-8")
