# pyright: reportMissingImports=false
"""`python -m benchmarks.scene_light.edges`: flying pixels of rendered boards, slats and corners.

Mitsuba and mitransient follow the light. That of a pixel is a sum over rays spread over the image
as the camera's point spread has it. Every ray also says which surface it meets, so the truth is
known: a pixel is flying if it takes light of two surfaces, and measures another distance than that
along its middle. The program gets frames with noise; it measures point spread and noise of them.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks.renewed.geometry import SPEED_OF_LIGHT
from benchmarks.renewed.rendering import Light, Rays, start_renderer, traced
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.scene_light.flying import FlyingPixels, FlyingPixelsOptions
from tofcorr.training.scene import shown_by

HEIGHT, WIDTH, FOCAL = 96, 128, 110.0  # pixels; 60 degrees wide
FREQUENCY = 20e6  # Hz
NOISE = 3.5e-3  # metres, at the median amplitude of a frame of boards
STRATA = 16  # rays along either side of a pixel
OTHER_LIGHT = 0.01  # share of another surface's light from which a pixel mixes two
DIRECT_WITHIN = 1e-3  # metres of path by which direct light may differ, in single precision
SMOOTH = (
    2.0  # pixels over which bounced light is averaged: its paths leave noise, unlike a camera's
)
LONGEST = 100.0  # metres of path; what leaves the scene has none
FLYING = 3.0  # standard deviations of noise by which a flying pixel is off


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A frame as measured, and the truth.

    Attributes:
        distance: Along the ray, as measured, metres (H, W).
        amplitude: As measured (H, W).
        truth: Distance along the middle of the pixel, metres (H, W).
        error: What mixing changes of the distance, without noise, metres (H, W).
        flying: Whether the pixel is flying (H, W).
        mixed: Whether it takes light of two surfaces (H, W).
        light: Amplitude of the surface along the middle of the pixel, if it filled it (H, W).
    """

    distance: np.ndarray
    amplitude: np.ndarray
    truth: np.ndarray
    error: np.ndarray
    flying: np.ndarray
    mixed: np.ndarray
    light: np.ndarray


def matrix() -> Any:  # noqa: ANN401 - three rows
    """The camera (3, 3)."""
    return ((FOCAL, 0.0, (WIDTH - 1) / 2), (0.0, FOCAL, (HEIGHT - 1) / 2), (0.0, 0.0, 1.0))


def rays(places: np.ndarray) -> np.ndarray:
    """Unit rays of places (..., 2), column and row."""
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    ray = np.concatenate([(places - middle) / FOCAL, np.ones_like(places[..., :1])], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


Vector = Sequence[float] | np.ndarray
Panel = tuple[np.ndarray, float]  # world_from_square (4, 4), reflectivity


def panel(centre: Vector, size: Vector, turned: np.ndarray, albedo: float) -> Panel:
    """A rectangle of half sizes around a centre, facing the camera if not turned."""
    pose = np.eye(4)
    pose[:3, :3] = turned @ np.diag([-1.0, 1.0, -1.0]) @ np.diag([*size, 1.0])
    pose[:3, 3] = centre
    return pose, albedo


def turned(*angles: float) -> np.ndarray:
    """Rotation by a tilt about x, one about y, and a roll, degrees."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("zxy", np.roll(angles, 1), degrees=True).as_matrix()


def wall(generator: np.random.Generator, near: float, far: float) -> Panel:
    """A wall behind everything."""
    tilt = generator.uniform(-15, 15, 2)
    z, albedo = generator.uniform(near, far), generator.uniform(0.3, 0.8)
    return panel([0, 0, z], [9, 9], turned(*tilt, 0), albedo)


def boards(generator: np.random.Generator) -> list[Panel]:
    """Two to four boards before a wall."""
    made = [wall(generator, 2.2, 3.2)]
    for _ in range(generator.integers(2, 5)):
        z = generator.uniform(0.9, 1.9)
        centre = [*(generator.uniform(-0.4, 0.4, 2) * z), z]
        size = generator.uniform(0.12, 0.35, 2)
        turn = turned(*generator.uniform(-35, 35, 2), generator.uniform(0, 180))
        made.append(panel(centre, size, turn, generator.uniform(0.2, 0.9)))
    return made


def slats(generator: np.random.Generator) -> list[Panel]:
    """Slats of two to five pixels beside each other before a wall, and a board."""
    made = [wall(generator, 2.0, 3.0)]
    z, roll = generator.uniform(1.0, 1.6), generator.uniform(0, 180)
    width = generator.uniform(2.0, 5.0) / 2 * z / FOCAL
    turn, albedo = turned(*generator.uniform(-20, 20, 2), roll), generator.uniform(0.3, 0.9)
    step = 2 * width * generator.uniform(1.6, 3.0)
    for k in range(-2, 3):
        across = turn @ np.array([1.0, 0, 0]) * k * step
        made.append(panel(across + np.array([0, 0, z]), [width, 0.6], turn, albedo))
    return made + boards(generator)[1:2]


def corner(generator: np.random.Generator) -> list[Panel]:
    """Two walls and a floor that meet before the camera: no edge between surfaces apart."""
    heading, z = generator.uniform(25, 65), generator.uniform(1.6, 2.6)
    albedo, x = generator.uniform(0.4, 0.8, 3), generator.uniform(-0.3, 0.3)
    made = []
    for angle, own, side in ((heading, albedo[0], 1), (heading - 90, albedo[1], -1)):
        face = turned(0, angle, 0)
        centre = np.array([x, 0, z]) + side * 6 * face @ np.array([1.0, 0.0, 0.0])
        made.append(panel(centre, [6, 6], face, own))
    return [*made, panel([0, generator.uniform(0.5, 1.0), z], [9, 9], turned(90, 0, 0), albedo[2])]


SCENES: dict[str, Callable[[np.random.Generator], list[Panel]]] = {
    "boards": boards,
    "slats": slats,
    "corner": corner,
}


def rendered(
    panels: list[Panel], spread: float, seed: int, bounces: int, paths: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render the light of every pixel.

    Args:
        panels: The scene.
        spread: Standard deviation of the point spread beside the area of a pixel, pixels.
        seed: Of rays and paths.
        bounces: Most bounces after the first.
        paths: Of every ray.

    Returns:
        Phasors (H, W, K + 1): direct light of each panel, then all that bounced; distances along
        the middles of the pixels (H, W); and the panels that these meet (H, W).
    """
    import drjit as dr
    import mitsuba as mi

    start_renderer()
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": bounces + 2, "rr_depth": 9},
        "light": {"type": "spot", "cutoff_angle": 60.0, "beam_width": 50.0},
    }
    for k, (pose, albedo) in enumerate(panels):
        grey = {"type": "rgb", "value": float(albedo)}
        look = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": grey}}
        to_world = mi.ScalarTransform4f(pose.tolist())
        scene[f"panel{k}"] = {"type": "rectangle", "to_world": to_world, "bsdf": look}
    world: Any = mi.load_dict(scene)
    shapes = [mi.ShapePtr(shape) for shape in world.shapes()]

    def met(beam: Rays) -> tuple[Light, Light]:
        """Return which surface rays meet, and how far away."""
        hit, number = world.ray_intersect(beam), mi.UInt32(len(shapes))
        for k, shape in enumerate(shapes):
            number = dr.select(hit.shape == shape, k, number)
        return number, hit.t

    generator = np.random.default_rng(seed)
    place = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1)[:, :, None] * 1.0
    cell = np.stack(np.meshgrid(np.arange(STRATA), np.arange(STRATA)), axis=-1).reshape(-1, 2)
    within = (cell + generator.random((HEIGHT, WIDTH, STRATA**2, 2))) / STRATA - 0.5
    ahead = rays(place + within + spread * generator.standard_normal(within.shape)).reshape(-1, 3)
    one = dr.arange(mi.UInt32, len(ahead) * paths) // paths
    start: Any = dr.zeros(mi.Float, len(ahead) * paths)
    beam = mi.Ray3f(
        mi.Point3f(start, start, start), dr.gather(mi.Vector3f, mi.Vector3f(ahead.T), one)
    )
    number, first = met(beam)
    kinds, wave = len(shapes) + 1, 2 * np.pi * FREQUENCY / SPEED_OF_LIGHT
    index = one // STRATA**2 * kinds
    total = [dr.zeros(mi.Float, HEIGHT * WIDTH * kinds) for _ in range(2)]

    def add(spec: Light, distance: Light, _wavelengths: object, active: Light) -> None:
        direct = dr.abs(distance - 2 * first) < DIRECT_WITHIN
        where = index + dr.select(direct, number, kinds - 1)
        light, known = spec.x / (paths * STRATA**2), active & (distance < LONGEST)
        for part, of in zip(total, (dr.cos, dr.sin), strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, part, light * of(wave * distance), where, known)

    dr.eval(traced(world, beam, seed, add), *total)
    phasor = (np.array(total[0]) + 1j * np.array(total[1])).reshape(HEIGHT, WIDTH, kinds)
    middle = mi.Vector3f(rays(place[:, :, 0]).reshape(-1, 3).T)
    owner, truth = (np.array(x) for x in met(mi.Ray3f(mi.Point3f(0.0), middle)))
    return phasor, truth.reshape(HEIGHT, WIDTH), owner.reshape(HEIGHT, WIDTH).astype(int)


def smooth(light: Any, owner: np.ndarray) -> np.ndarray:  # noqa: ANN401 - complex
    """Phasors (H, W), averaged with neighbours on the same panel: takes off the noise of paths."""
    from scipy.ndimage import gaussian_filter

    result = np.zeros_like(light)
    for own in np.unique(owner):
        on = (owner == own).astype(float)
        parts = (gaussian_filter(part * on, SMOOTH) for part in (light.real, light.imag))
        real, imaginary = (part / np.maximum(gaussian_filter(on, SMOOTH), 1e-9) for part in parts)
        result = np.where(on > 0, real + 1j * imaginary, result)
    return result


def unmixed(light: np.ndarray, owner: np.ndarray, mixed: np.ndarray) -> np.ndarray:
    """Amplitudes (H, W) of mixed pixels from the nearest unmixed pixel of the same panel."""
    from scipy.ndimage import distance_transform_edt

    result = light.copy()
    for own in np.unique(owner):
        known = (owner == own) & ~mixed
        if known.any():
            place: Any = distance_transform_edt(~known, return_distances=False, return_indices=True)
            result = np.where(owner == own, light[tuple(place)], result)
    return result


def frame_of(kind: str, seed: int, spread: float, bounces: int = 0, paths: int = 1) -> Frame:
    """Render one frame and add noise; a seed always gives the same."""
    generator = np.random.default_rng([seed, list(SCENES).index(kind)])
    panels = SCENES[kind](generator)
    phasor, truth, owner = rendered(panels, spread, seed, bounces, paths)
    metres = SPEED_OF_LIGHT / (4 * np.pi * FREQUENCY)
    light = np.abs(phasor[..., :-1])
    other = 1 - np.take_along_axis(light, owner[..., None], -1)[..., 0] / light.sum(-1)
    error = metres * np.angle(phasor[..., :-1].sum(-1) * np.exp(-1j * truth / metres))
    clean = phasor[..., :-1].sum(-1) + smooth(phasor[..., -1], owner)
    scale = np.median(np.abs(clean))
    mixed = other > OTHER_LIGHT
    noise = generator.standard_normal((2, *clean.shape)) * NOISE / metres * scale
    noisy = clean + noise[0] + 1j * noise[1]
    return Frame(
        distance=metres * (np.angle(noisy) % (2 * np.pi)),
        amplitude=1000 * np.abs(noisy) / scale,
        truth=truth,
        error=error,
        flying=mixed & (np.abs(error) > FLYING * NOISE * scale / np.abs(clean)),
        mixed=mixed,
        light=1000 / scale * unmixed(np.abs(phasor[..., :-1].sum(-1)), owner, mixed),
    )


def median_filter(distance: np.ndarray) -> np.ndarray:
    """How far every pixel is off the median of 3 x 3."""
    from scipy.ndimage import median_filter as median

    return np.abs(distance - median(distance, 3))


def neighbour_distance(distance: np.ndarray) -> np.ndarray:
    """Mean distance in space to the eight neighbours, over the distance of the pixel."""
    place = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1)
    points = np.pad(distance[..., None] * rays(place), [(1, 1), (1, 1), (0, 0)], mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(points, (3, 3), axis=(0, 1))
    apart = np.linalg.norm(windows - windows[..., 1:2, 1:2], axis=2)
    return apart.sum(axis=(-2, -1)) / 8 / distance


def truths(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """True distances, and what mixing changes of them, (N, H, W), metres."""
    return np.stack([f.truth for f in frames]), np.stack([f.error for f in frames])


def scores(frames: list[Frame], flag: np.ndarray) -> str:
    """How well flags (N, H, W) agree with the truth, in percent."""
    flying, (_, error) = np.stack([f.flying for f in frames]), truths(frames)
    both, square = (flying & flag).sum(), np.where(flying, error**2, 0)
    return (
        f"flying {100 * flying.mean():5.2f}  flagged {100 * flag.mean():5.2f}"
        f"  precision {100 * both / max(flag.sum(), 1):5.1f}"
        f"  recall {100 * both / max(flying.sum(), 1):5.1f}"
        f"  squared error gone {100 * square[flag].sum() / max(square.sum(), 1e-12):6.2f}"
    )


def main() -> None:
    """Render, find, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--frames", type=int, default=20, help="of each kind of scene")
    parser.add_argument("--spread", type=float, default=0.35, help="Gaussian blur, pixels")
    parser.add_argument("--false-alarm", type=float, default=1e-3)
    parser.add_argument("--bounces", type=int, default=4, help="in the corners")
    given = parser.parse_args()
    made = {
        kind: [
            frame_of(kind, given.seed + k, given.spread, *((given.bounces, 2) * (kind == "corner")))
            for k in range(given.frames)
        ]
        for kind in SCENES
    }
    camera = CameraIntrinsics(width=WIDTH, height=HEIGHT, matrix=matrix())
    images = [
        [torch.tensor(f.distance).float(), torch.tensor(f.amplitude).float()]
        for f in made["boards"] + made["slats"]
    ]
    recording = [torch.stack(list(x)) for x in zip(*images, strict=True)]
    wanted = FlyingPixelsOptions(false_alarm=given.false_alarm)
    shown = shown_by(recording[0], recording[1], camera, "radial", wanted)
    assert shown is not None, "the frames show flying pixels"
    width = (given.spread**2 + 1 / 12) ** 0.5
    print(f"point spread {shown.point_spread_px:.3f} px measured, {width:.3f} true")
    finder = FlyingPixels(camera, "radial", shown)
    flags, given_back = {}, {}
    for kind, frames in made.items():
        found = [
            finder.found(torch.tensor(f.distance).float(), torch.tensor(f.amplitude).float())
            for f in frames
        ]
        flags[kind], given_back[kind] = (
            np.stack([x.numpy() for x in y]) for y in zip(*found, strict=True)
        )
        print(f"{kind:8}{scores(frames, flags[kind])}")
        seen, truth, error = given_back[kind], *truths(frames)
        known = np.isfinite(seen)
        if known.any():
            off, before = np.abs(seen - truth)[known], np.abs(error[known])
            print(
                f"  a surface is given to {100 * known.sum() / flags[kind].sum():.0f} % of the"
                f" flagged: off by {1e3 * np.median(off):.1f} mm (median; before"
                f" {1e3 * np.median(before):.0f}),"
                f" by more than 5 cm {100 * np.mean(off > 0.05):.2f} %"
            )
    share = np.mean([own.mean() for own in flags.values()])
    for name, rank in (("median of 3 x 3", median_filter), ("neighbours", neighbour_distance)):
        print(f"{name}, which flags as many of all:")
        ranks = {
            kind: np.stack([rank(f.distance) for f in frames]) for kind, frames in made.items()
        }
        limit = np.quantile(np.concatenate(list(ranks.values())), 1 - share)
        for kind, frames in made.items():
            print(f"  {kind:8}{scores(frames, ranks[kind] > limit)}")


if __name__ == "__main__":
    main()
