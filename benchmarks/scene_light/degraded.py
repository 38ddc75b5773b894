"""Do degraded frames err as rendered light does, and what do they leave of a recording?

    python -m benchmarks.scene_light.degraded --seed 1
    python -m benchmarks.scene_light.degraded --seed 1 --recordings FOLDER

The first compares errors class by class: at edges, near corners, elsewhere. Ideal
frames of the scenes go through the sensor with and without its stages of light; gain and point
spread are the true ones. Camera errors and noise are left out of both. The second diagnoses
recordings of a robot before a wall beside another surface.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.scene_light import edges, rooms
from benchmarks.scene_light.bounces import camera
from benchmarks.scene_light.stations import ROOMS, record
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import resolve_options
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile

Image = np.ndarray
CORNER = 0.15  # metres from another surface: near a corner
SPREAD = 0.35  # pixels, beside the area of a pixel
BLUR = (SPREAD**2 + 1 / 12) ** 0.5  # as a Gaussian


def sensor(of: CameraIntrinsics, frequency: float, **stages: Any) -> SensorModel:  # noqa: ANN401
    """A camera without errors of its own, with some stages of light."""
    values = {
        "format": "tofcorr-sensor",
        "version": 1,
        "camera": of.section(),
        "depth_kind": "radial",
        "modulation_frequency_hz": frequency,
        "validity": {"radial_distance_m": [0.1, 20.0]},
    }
    return SensorModel(resolve_options(SensorFile, values | stages), torch.float64)


def errors(model: SensorModel, distance: Image, amplitude: Image) -> Image:
    """What a sensor changes of the distance (H, W), metres."""
    with torch.inference_mode():
        images = torch.tensor(distance), torch.tensor(amplitude)
        return model(*images, noise=False).depth.numpy() - distance


def near_another(place: Image, shape: Image) -> Image:
    """Where another surface is within `CORNER` of points (H, W, 3)."""
    from scipy.spatial import KDTree

    result = np.zeros(shape.shape, dtype=bool)
    for own in np.unique(shape[shape >= 0]):
        mine, others = shape == own, (shape >= 0) & (shape != own)
        if others.any():
            result[mine] = KDTree(place[others]).query(place[mine])[0] < CORNER
    return result


def lines(title: str, true: list[Image], said: dict[str, list[Image]]) -> list[str]:
    """Lines of a class of pixels: of the rendered light, then of each sensor, in mm."""
    truth = 1e3 * np.concatenate(true)
    rows = []
    for name, images in {"rendered": true, **said}.items():
        own = 1e3 * np.concatenate(images)
        use = np.isfinite(truth) & np.isfinite(own)
        if not use.any():
            return []
        a, b = truth[use], own[use]
        moved = float(np.abs(np.sort(a) - np.sort(b)).mean())  # Earth mover's distance.
        spread = np.quantile(b, [0.05, 0.5, 0.95])
        numbers = [np.sqrt((b**2).mean()), *spread, moved, np.sqrt(((a - b) ** 2).mean())]
        values = "".join(f"{value:9.1f}" for value in numbers)
        rows.append(f"{title:22}{name:16}{use.sum():7}{values}")
    return rows


def of_bounces(seed: int, views: int) -> list[str]:
    """Scenes with second bounces."""
    light = {"frequencies_hz": [rooms.FREQUENCY], "gain": 1 / rooms.GAIN}
    light["light_half_angle_deg"] = rooms.CONE
    kinds = {
        "without": sensor(camera(), rooms.FREQUENCY),
        "second bounces": sensor(camera(), rooms.FREQUENCY, second_bounces=light),
    }
    classes: dict[str, tuple[list[Image], dict[str, list[Image]]]] = {
        name: ([], {kind: [] for kind in kinds}) for name in ("near a corner", "elsewhere")
    }
    for scene in rooms.SCENES:
        for frame in rooms.rendered(scene, seed, views):
            found = {k: errors(own, frame.distance, frame.amplitude) for k, own in kinds.items()}
            true = frame.error
            corner = near_another(frame.distance[..., None] * rooms.rays(), frame.shape)
            for name, chosen in (("near a corner", corner), ("elsewhere", ~corner)):
                classes[name][0].append(true[chosen])
                for kind, image in found.items():
                    classes[name][1][kind].append(image[chosen])
    return [line for name, (true, said) in classes.items() for line in lines(name, true, said)]


def of_edges(seed: int, frames: int) -> list[str]:
    """Boards and slats before a wall: pixels that see two surfaces, and others."""
    lens = CameraIntrinsics(width=edges.WIDTH, height=edges.HEIGHT, matrix=edges.matrix())
    mixed = {"name": "mixed_pixels", "sigma_px": [BLUR], f"share_{BLUR:g}px": 1.0}
    kinds = {
        "without": sensor(lens, edges.FREQUENCY),
        "mixed pixels": sensor(lens, edges.FREQUENCY, effects=[mixed]),
    }
    rows = []
    for scene in ("boards", "slats"):
        made = [edges.frame_of(scene, seed + k, SPREAD) for k in range(frames)]
        found = [{k: errors(own, f.truth, f.light) for k, own in kinds.items()} for f in made]
        for title, edge in ((f"edge, {scene}", True), (f"elsewhere, {scene}", False)):
            chosen = [f.mixed == edge for f in made]
            true = [f.error[use] for f, use in zip(made, chosen, strict=True)]
            said = {
                kind: [own[kind][use] for own, use in zip(found, chosen, strict=True)]
                for kind in kinds
            }
            rows += lines(title, true, said)
    return rows


def recordings(seed: int, poses: int, out: Path) -> None:
    """Diagnose recordings, and print what model and degraded frames leave."""
    for room in ROOMS:
        found = diagnose(record(room, seed, poses, out / room), config={"page": False})
        last, degraded = found.stages[-1].gap, found.degraded
        assert last is not None
        assert degraded is not None
        sets = "; ".join(", ".join(members) for members in found.cause_sets)
        numbers = f"{1e3 * last:6.2f}{1e3 * degraded.gap:8.2f}{degraded.gap / last:7.2f}"
        print(f"{room:16}{numbers}  {sets}", flush=True)


def main() -> None:
    """Print one of the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--views", type=int, default=4, help="of each scene")
    parser.add_argument("--recordings", type=Path, help="write them here, and diagnose them")
    parser.add_argument("--poses", type=int, default=36, help="of a recording")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.recordings is not None:
        print(f"{'mm left by':16}{'model':>6}{'degraded':>8}{'ratio':>7}  named")
        recordings(given.seed, given.poses, given.recordings)
        return
    titles = ("RMS", "5 %", "50 %", "95 %", "moved", "off")
    print(f"{'mm':22}{'':16}{'pixels':>7}" + "".join(f"{title:>9}" for title in titles))
    print("\n".join([*of_bounces(given.seed, given.views), *of_edges(given.seed, given.views)]))


if __name__ == "__main__":
    main()
