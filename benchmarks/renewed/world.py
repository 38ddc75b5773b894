"""Everything of a recording that is drawn before light enters the camera."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval

from benchmarks.renewed.geometry import (
    SPEED_OF_LIGHT,
    Array,
    Camera,
    Random,
    image_grid,
    inverse,
    rotations,
    small_motions,
    transforms,
)
from benchmarks.renewed.ranges import RANGES, Range, draw
from benchmarks.renewed.rendering import Room

Wanted = Mapping[str, Any]
CONTRAST = 0.55  # modulated share of the returned light
READ_NOISE = 30.0  # electrons
NOMINAL_US = 800.0  # exposure
WHITE = 0.8  # reflectivity
INDOORS = ("floor", "corner", "closed")
TRIES = 60  # draws of a station until it lies between the walls
MARGIN = 0.1  # of the nearest distance, between camera and wall


@dataclass(frozen=True)
class BaseErrors:
    """A cubic in distance, squares of column and row, a square in amplitude: what a base has."""

    middle: float
    half: float
    of_distance: tuple[float, ...]  # metres, of 1, v, v^2, v^3 with v the distance in (-1, 1)
    of_pixel: tuple[float, ...]  # of column, row, column^2, row^2, each in (-1, 1)
    of_amplitude: tuple[float, ...]  # of u, u^2 with u the amplitude over a bright one

    def terms(self, distance: Array, amplitude: Array) -> dict[str, Any]:
        """Errors in metres by term; `amplitude` (N, H, W) is over that of a bright pixel."""
        v = np.clip((distance - self.middle) / self.half, -2.3, 2.3)
        column, row = image_grid(*distance.shape[1:])
        a, b, aa, bb = self.of_pixel
        return {
            "distance": polyval(v, self.of_distance),
            "pixel": a * column + b * row + aa * column**2 + bb * row**2,
            "amplitude": polyval(amplitude, (0.0, *self.of_amplitude)),
        }

    def at(self, distance: Array, amplitude: Array) -> Array:
        """The error (N, H, W) in metres."""
        return sum(self.terms(distance, amplitude).values(), np.zeros(1))


@dataclass(frozen=True)
class Sensor:
    """One camera; `lens.sensitivity` is in electrons of a white target at 1 m."""

    lens: Camera
    frequencies: tuple[float, ...]  # Hz, ascending
    sun: float  # electrons of sunlight on a white target at nominal exposure
    tail: float
    spatial_filter: str
    temporal_filter: float
    rounding: float  # metres
    depth_kind: str
    base: BaseErrors

    @property
    def weights(self) -> Array:
        """Weight of each frequency in the depth: the inverse of its variance."""
        square = np.array(self.frequencies) ** 2
        return square / square.sum()


@dataclass(frozen=True)
class Design:
    """How a recording is laid out; lengths in metres, angles in radians."""

    frames: int
    near: float
    far: float
    tilt: float
    moving: bool
    repeated: float
    repeats: int
    robot: float
    scene: str
    target: str
    mask: str
    ransac: float
    exposure: str
    logged: tuple[str, ...]  # optional columns of frames.csv that are written


@dataclass(frozen=True)
class Way:
    """The camera's way before the target."""

    seconds: Array  # (N,) time stamps
    pose_id: np.ndarray  # (N,)
    pauses: Array  # (N,) seconds of rest before each frame, beyond the usual
    camera_at: Callable[[Array], Array]  # seconds after each stamp (N,) -> target_from_camera

    @property
    def poses(self) -> int:
        """Number of poses."""
        return int(self.pose_id[-1]) + 1


@dataclass(frozen=True)
class Conditions:
    """What happens around a recording, one value a frame."""

    exposure: Array  # us
    room: Array  # degrees Celsius
    body: Array
    ambient: Array  # background light, the camera's own units; the sun is not among it
    powered: float  # seconds of power before the first frame


@dataclass(frozen=True)
class Surface:
    """The target is z = 0, seen from positive z; a board of `half` sizes, or endless walls."""

    room: Room
    half: tuple[float, float]  # of a board, metres; infinite for a wall
    behind: float  # metres from the board back to the wall
    square: float  # metres: the side of a square, or the size of a texture's grain
    dark: float
    waves: Array  # (6, 3): of the texture
    kind: tuple[str, ...]  # of every frame: white, checkerboard, grey or texture

    def reflectivity(self, x: Array, y: Array) -> Array:
        """Reflectivity (N, H, W) of the target at its coordinates (N, H, W), metres."""
        result = np.full(x.shape, WHITE)
        for name in set(self.kind):
            frames = np.array([one == name for one in self.kind])
            result[frames] = self._pattern(name, x[frames], y[frames])
        return result

    def _pattern(self, name: str, x: Array, y: Array) -> Array:
        u, v = np.floor(x / self.square), np.floor(y / self.square)
        if name == "checkerboard":
            return np.where((u + v) % 2 > 0, WHITE, self.dark)
        if name == "grey":
            return self.dark + (WHITE - self.dark) * ((u + 2 * v) % 5 / 4)
        if name == "texture":
            wave = sum(np.sin((a * x + b * y) / self.square + c) for a, b, c in self.waves) / 6
            return np.clip(0.45 + 0.5 * wave, 0.08, WHITE)
        return np.full(x.shape, WHITE)


@dataclass(frozen=True)
class World:
    """A camera on a robot before a target."""

    sensor: Sensor
    design: Design
    way: Way
    conditions: Conditions
    surface: Surface
    tool_from_camera: Array  # (4, 4)
    guess: Array  # (4, 4) of it, as recording.yaml tells
    world_from_target: Array  # (4, 4)
    seed: int  # of what is rendered

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.design.frames

    @cached_property
    def pixel_position(self) -> tuple[Array, Array]:
        """Column and row (H, W), each from -1 to 1."""
        return image_grid(self.sensor.lens.height, self.sensor.lens.width)

    def world_from_tool(self, late: Array | float = 0.0) -> Array:
        """True poses (N, 4, 4) some seconds after each frame's stamp."""
        there = self.way.camera_at(np.broadcast_to(np.asarray(late, float), (self.frames,)))
        return self.world_from_target @ there @ inverse(self.tool_from_camera)


def draw_world(rng: Random, wanted: Wanted | None = None) -> World:
    """Draw a camera, a robot, a target and a design; `wanted` fixes some of the design."""
    near = draw("near_m", rng)
    far = min(near * draw("farthest_times", rng), RANGES["farthest_m"])
    sensor = _draw_sensor(rng, near, far)
    pixels = sensor.lens.width * sensor.lens.height
    design = _draw_design(rng, pixels, near, far, wanted or {})
    room = _draw_room(rng, design)
    way = _draw_way(rng, design, room)
    arm = np.array([0.0, 0.0, 0.09]) + rng.normal(0, 0.06, 3)
    mounting = small_motions(arm, rng.normal(0, [0.2, 0.2, 1.5]))
    metres, radians = RANGES["guess"]
    miss = small_motions(rng.normal(0, metres, 3), rng.normal(0, radians, 3))
    ahead = far + rng.uniform(0.25, 0.6)
    place = small_motions(np.array([ahead, *rng.uniform(-0.3, 0.3, 2)]), np.zeros(3))
    upright = small_motions(np.zeros(3), np.array([0.0, -np.pi / 2, 0.0]))
    turn = small_motions(np.zeros(3), rng.normal(0, [0.03, 0.03, 0.5]))
    return World(
        sensor=sensor,
        design=design,
        way=way,
        conditions=_draw_conditions(rng, design, way),
        surface=_draw_surface(rng, design, room, way),
        tool_from_camera=mounting,
        guess=mounting @ miss,
        world_from_target=turn @ place @ upright,
        seed=int(rng.integers(2**31)),
    )


def session_again(rng: Random, world: World, **design: object) -> World:
    """Another session of the same camera, robot and target; `design` changes entries of its own.

    Exposures are those of the first session, unless their design changes.
    """
    levels = np.unique(world.conditions.exposure)
    world = replace(world, design=replace(world.design, **design))  # type: ignore[arg-type]
    room = world.surface.room
    way = _draw_way(rng, world.design, room)
    kinds = _draw_surface(rng, world.design, room, way).kind
    conditions = _draw_conditions(rng, world.design, way)
    if "exposure" not in design and world.design.exposure == "random":
        exposure = rng.choice(levels, size=way.poses)[way.pose_id]
        conditions = replace(conditions, exposure=exposure)
    return replace(
        world,
        way=way,
        conditions=conditions,
        surface=replace(world.surface, kind=kinds),
        seed=int(rng.integers(2**31)),
    )


def _draw_sensor(rng: Random, near: float, far: float) -> Sensor:
    """Draw a camera that is exposed for distances from near to far."""
    frequencies = tuple(1e6 * f for f in draw("frequencies_mhz", rng))
    electrons = _electrons(draw("noise_mm", rng) * 1e-3, frequencies)
    outdoor = rng.uniform() < RANGES["outdoor"]
    sun = draw("sun", rng)
    return Sensor(
        lens=replace(_draw_lens(rng), sensitivity=electrons * float(np.sqrt(near * far)) ** 2),
        frequencies=frequencies,
        sun=sun * electrons if outdoor else 0.0,
        tail=draw("tails", rng),
        spatial_filter=draw("spatial_filter", rng),
        temporal_filter=draw("temporal_filter", rng),
        rounding=1e-3 * draw("rounding_mm", rng),
        depth_kind=draw("depth_kind", rng),
        base=BaseErrors(
            middle=(near + far) / 2,
            half=(far - near) / 2,
            of_distance=tuple(rng.normal(0, np.array([20, 12, 6, 4]) * 1e-3)),
            of_pixel=tuple(rng.normal(0, np.array([3, 3, 6, 6]) * 1e-3)),
            of_amplitude=tuple(rng.normal(0, np.array([8, 4]) * 1e-3)),
        ),
    )


def _draw_lens(rng: Random) -> Camera:
    width, height = draw("images", rng)
    focal = width * draw("focal_widths", rng)
    barrel = draw("barrel", rng)
    off = rng.normal(0, 0.012 * width, 2)
    return Camera(
        width=width,
        height=height,
        focal=(focal, focal * rng.uniform(0.997, 1.003)),
        centre=((width - 1) / 2 + off[0], (height - 1) / 2 + off[1]),
        distortion=(barrel, -0.3 * barrel, *rng.normal(0, 4e-4, 2), 0.0),
        sensitivity=1.0,
        counts_per_electron=Range(0.005, 0.3, log=True).draw(rng),
    )


def _electrons(noise: float, frequencies: tuple[float, ...]) -> float:
    """Amplitude A at which the depth of one frame has this noise.

    A tap holds A / CONTRAST + READ_NOISE^2 electrons, and as much variance.
    """
    scale = SPEED_OF_LIGHT / (4 * np.pi * np.linalg.norm(frequencies))
    square, linear = 2 * (noise / scale) ** 2, 1 / CONTRAST
    return float((linear + np.sqrt(linear**2 + 4 * square * READ_NOISE**2)) / (2 * square))


def _draw_design(rng: Random, pixels: int, near: float, far: float, wanted: Wanted) -> Design:
    """Draw a design; `wanted` fixes what an effect cannot do without."""
    frames = min(draw("frames", rng), max(15, int(RANGES["most_pixels"] / pixels)))
    finest = 1e-3 * RANGES["least_ransac_mm"]
    layout = {
        "frames": frames,
        "near": near,
        "far": far,
        "tilt": np.deg2rad(draw("tilt_deg", rng)),
        "moving": bool(rng.uniform() < RANGES["on_the_move"]),
        "repeated": draw("repeated", rng),
        "repeats": draw("repeats", rng),
        "robot": 1e-3 * draw("robot_mm", rng),
        "scene": draw("scenes", rng),
        "target": draw("targets", rng),
        "mask": draw("masks", rng),
        "ransac": max(draw("ransac_share", rng) * np.sqrt(near * far), finest),
        "exposure": draw("exposures", rng),
    }
    optional = ("integration_time_us", "body_temperature_c", "room_temperature_c", "ambient")
    needed = wanted.get("logged", ())
    logged = [name for name in optional if rng.uniform() < RANGES["logged"] or name in needed]
    layout |= {key: value for key, value in wanted.items() if key != "logged"}
    if layout["moving"] and layout["scene"] in INDOORS:
        layout["scene"] = "wall"  # a way without stops would lead through floor and walls
    return Design(**layout, logged=tuple(logged))


def _draw_room(rng: Random, design: Design) -> Room:
    """Draw the walls of a design."""
    low, left = float(np.sqrt(design.near * design.far)) * rng.uniform(0.3, 0.6, 2)
    side = float(left * rng.choice([-1.0, 1.0]))
    closed, corner = design.scene == "closed", design.scene in ("corner", "closed")
    return Room(
        floor=-float(low) if corner or design.scene == "floor" else None,
        side=side if corner else None,
        other_side=-np.sign(side) * design.far * rng.uniform(0.8, 1.2) if closed else None,
        ceiling=design.far * rng.uniform(0.8, 1.2) if closed else None,
        back=design.far * rng.uniform(1.3, 1.6) if closed else None,
        target_albedo=WHITE,
    )


def _draw_surface(rng: Random, design: Design, room: Room, way: Way) -> Surface:
    """Draw the target of a design."""
    middle = float(np.sqrt(design.near * design.far))
    half = middle * rng.uniform(0.3, 0.6, 2)
    if design.scene != "board":
        half = np.full(2, np.inf)
    names = (design.target,) if design.target != "both" else ("white", "checkerboard")
    per_pose = rng.integers(len(names), size=way.poses)
    return Surface(
        room=room,
        half=(float(half[0]), float(half[1])),
        behind=rng.uniform(0.15, 0.8) * middle,
        square=middle * rng.uniform(0.06, 0.15),
        dark=rng.uniform(0.06, 0.2),
        waves=np.column_stack([rng.normal(0, 2, (6, 2)), rng.uniform(0, 6, 6)]),
        kind=tuple(names[per_pose[i]] for i in way.pose_id),
    )


def _draw_conditions(rng: Random, design: Design, way: Way) -> Conditions:
    """Draw the conditions of a way."""
    t, n = way.seconds, design.frames
    swing = draw("room_k", rng)
    periods = rng.uniform(0.3, 2.5, 4) * max(t[-1], 60.0)
    waves = np.sin(2 * np.pi * t[:, None] / periods + rng.uniform(0, 2 * np.pi, 4)).sum(1)
    room = rng.uniform(17.0, 26.0) + swing * (waves - waves.min()) / max(np.ptp(waves), 1e-6)
    powered = rng.uniform(0.0, 60.0)
    levels = rng.uniform(0, 1.5, rng.integers(2, 5))
    lamp = levels[rng.integers(len(levels), size=way.poses)][way.pose_id]
    return Conditions(
        exposure=_draw_exposure(rng, design, way),
        room=room,
        body=room + 11.0 * heat(way, powered, 500.0) + rng.normal(0, 0.08, n),
        ambient=lamp + 0.1 * (1 + np.sin(t / 700.0)),
        powered=powered,
    )


def heat(way: Way, powered: float, constant: float) -> Array:
    """Share of full warmth (N,) by Newton's law; pauses cool at the same rate."""
    level, result = 1 - np.exp(-powered / constant), np.empty(len(way.seconds))
    before = 0.0
    for i, (now, pause) in enumerate(zip(way.seconds, way.pauses, strict=True)):
        level *= np.exp(-pause / constant)
        level = 1 - (1 - level) * np.exp(-(now - before - pause) / constant)
        result[i], before = level, now
    return result


def _draw_exposure(rng: Random, design: Design, way: Way) -> Array:
    levels = NOMINAL_US * np.exp(np.linspace(-1, 1, rng.integers(3, 7)) * rng.uniform(0.4, 1.1))
    n = design.frames
    if design.exposure == "constant":
        return np.full(n, levels[0])
    if design.exposure == "bracketed":  # at one pose as well
        return levels[rng.integers(len(levels), size=n)]
    if design.exposure == "automatic":
        z = way.camera_at(np.zeros(n))[:, 2, 3]
        wanted = NOMINAL_US * (z**2 / (design.near * design.far)) ** 0.8
        return np.round(np.clip(wanted, 100.0, 8000.0) / 50.0) * 50.0
    return levels[rng.integers(len(levels), size=way.poses)][way.pose_id]


def _draw_way(rng: Random, design: Design, room: Room) -> Way:
    """Draw a way of a design that stays in a room."""
    return _moving(rng, design) if design.moving else _standing(rng, design, room)


def _standing(rng: Random, design: Design, room: Room) -> Way:
    ids: list[int] = []  # of stations; a share of them comes several times in a row
    while len(ids) < design.frames:
        times = design.repeats if rng.uniform() < design.repeated else 1
        ids += [ids[-1] + 1 if ids else 0] * times
    pose_id = np.array(ids[: design.frames])
    new = np.diff(pose_id, prepend=-1) > 0
    n, count = design.frames, int(pose_id[-1]) + 1
    gaps = np.where(new, rng.uniform(4.0, 30.0) * rng.uniform(0.6, 1.4, n), rng.uniform(0.1, 0.5))
    pauses = np.zeros(n)
    later = np.flatnonzero(new)[1:]
    chosen = rng.choice(later, size=min(rng.integers(0, 3), len(later)), replace=False)
    pauses[chosen] = rng.uniform(200.0, 1200.0, len(chosen))
    gaps[0] = 0.0
    where = _camera(_indoors(rng, design, room, count))[pose_id]
    seconds = np.cumsum(gaps + pauses)
    return Way(seconds, pose_id, pauses, lambda late: np.broadcast_to(where, (len(late), 4, 4)))


def _moving(rng: Random, design: Design) -> Way:
    """A sum of slow swings in every direction; frames every half second."""
    n = design.frames
    seconds = np.cumsum(np.append(0.0, 0.5 + rng.uniform(-0.05, 0.05, n - 1)))
    middle, half = (design.near + design.far) / 2, (design.far - design.near) / 2
    size = np.array([0.92 * half, design.tilt, design.tilt, 1.0, 0.12 * middle, 0.12 * middle])
    quick, slow = [9.0, 6.0, 6.0, 14.0, 8.0, 8.0], [16.0, 12.0, 12.0, 30.0, 16.0, 16.0]
    rate = 2 * np.pi / rng.uniform(quick, slow)
    start = rng.uniform(0, 2 * np.pi, 6)

    def camera_at(late: Array) -> Array:
        place = size * np.sin(rate * (seconds + late)[:, None] + start)
        place[:, 0] += middle
        return _camera(place)

    return Way(seconds, np.arange(n), np.zeros(n), camera_at)


def _indoors(rng: Random, design: Design, room: Room, count: int) -> Array:
    """Places (count, 6) between the walls: those outside get other tilts, at last none at all."""
    places = _draw_places(rng, count, design)
    for attempt in range(TRIES):
        where, outside = _camera(places)[:, :, 3], np.zeros(count, dtype=bool)
        for axis, wall in room.sides():
            outside |= where[:, axis] * np.sign(wall) > abs(wall) - MARGIN * design.near
        if not outside.any():
            break
        tilt = 0.0 if attempt == TRIES - 2 else design.tilt
        places[outside, 1:3] = rng.uniform(-tilt, tilt, (int(outside.sum()), 2))
    return places


def _draw_places(rng: Random, count: int, design: Design) -> Array:
    """Distance, tilts, roll and the point looked at (count, 6); distances evenly, out of order."""
    share = rng.permutation((np.arange(count) + rng.uniform(0, 1, count)) / count)
    distance = design.near + (design.far - design.near) * share
    tilt = rng.uniform(-design.tilt, design.tilt, (count, 2))
    roll = rng.uniform(-1.5, 1.5, count) * rng.choice([0.3, 1.0])
    look = rng.uniform(-0.12, 0.12, (count, 2)) * np.sqrt(design.near * design.far)
    return np.column_stack([distance, tilt, roll, look])


def _camera(place: Array) -> Array:
    """target_from_camera (N, 4, 4): at a distance, tilted, rolled about its axis."""
    distance, tilt_x, tilt_y, roll, look_x, look_y = place.T
    zero = np.zeros_like(roll)
    facing = np.diag([1.0, -1.0, -1.0])
    turn = rotations(np.stack([tilt_x, tilt_y, zero], -1)) @ facing
    turn = turn @ rotations(np.stack([zero, zero, roll], -1))
    return transforms(turn, np.stack([look_x, look_y, zero], -1) - distance[:, None] * turn[..., 2])
