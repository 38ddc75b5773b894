"""Does the stated uncertainty of a corrected pixel hold, in the light of scenes it has not seen?

    python -m benchmarks.scene_light.uncertainty --seed 1

`corrector.uncertainty` gives the standard deviation of each pixel of the scenes of
`benchmarks.scene_light.bounces`, with noise and a base error that was calibrated on lone walls, and
of `benchmarks.scene_light.edges` with flying pixels. The error over it should be below 1 in 68.3
and below 2 in 95.4 percent of the pixels. Pixels that are not valid are left out.
"""

import argparse
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from benchmarks.scene_light import edges, rooms
from benchmarks.scene_light.bounces import OTHER_SEED, Image, base_error, calibrate, camera
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.scene_light.flying import FlyingPixelsOptions
from tofcorr.training.scene import shown_by

VARIANCE = 3.5e-3**2 * 300  # square metres times counts: 3.5 mm at 300 counts
NEAR = 0.15  # metres to another surface
STEP = 0.06  # from a pixel to the next, as a share of the distance: an edge
CLASSES = ("elsewhere", "near a corner", "edge")
LOG = {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 1}
TERMS = [{"kind": "distance_polynomial", "degree": 5}, LOG]


def seen(
    frame: rooms.Frame, draw: np.random.Generator | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and amplitude (H, W) as the camera gives them; None: without noise."""
    amplitude = frame.amplitude * abs(1 + frame.ratio)
    noise = np.sqrt(VARIANCE / amplitude) * (draw.normal(size=amplitude.shape) if draw else 0.0)
    distance = frame.distance + frame.error + base_error(frame.distance + frame.error, amplitude)
    return torch.tensor(distance + noise).float(), torch.tensor(amplitude).float()


def built(view: CameraIntrinsics, terms: list[Any], domain: Domain, **known: Any) -> DepthCorrector:  # noqa: ANN401
    """A corrector of radial distances."""
    options = ErrorModelOptions.from_mapping({"terms": terms}, "benchmark")
    fixed = {"tool_from_camera": torch.eye(4).double(), "hand_eye_estimated": False}
    values = fixed | {"camera": view, "depth_kind": "radial", "name": "walls", "domain": domain}
    return DepthCorrector.from_state(CalibrationState(error_model=options, **values, **known))


def calibrated(seed: int, views: int) -> DepthCorrector:
    """Calibrate on walls: the gain by their curvature, the base error on lone ones."""
    known, draw = calibrate(seed, views, (0.0, 0.0, 0.0)), np.random.default_rng(seed)
    lone = rooms.rendered("lone_wall", seed, views)
    noisy = torch.stack([seen(frame, draw)[0] for frame in lone]).double()
    # The functions are taken where there is no noise: beside the amplitude, which has none here,
    # a distance tells its own noise.
    distance, light = (
        torch.stack(images).double() for images in zip(*map(seen, lone), strict=True)
    )
    ends = [
        Interval(float(image.min()), float(image.max()))
        for image in (distance, light, light * distance**2)
    ]
    domain = Domain(
        height=rooms.HEIGHT,
        width=rooms.WIDTH,
        radial_distance=ends[0],
        amplitude=ends[1],
        normalised_amplitude=ends[2],
    )
    model = ErrorModel(ErrorModelOptions.from_mapping({"terms": TERMS}, "benchmark"), domain)
    columns = []
    for unit in torch.eye(len(model.symbols())).double():
        model.set_coefficient_vector(unit)
        columns.append(model(distance, light).detach().reshape(-1))
    weight = light.sqrt().reshape(-1)  # Of noise whose variance falls with one over the light.
    design = torch.stack(columns, dim=1) * weight[:, None]
    truth = torch.tensor(np.stack([frame.distance for frame in lone]))
    off = (noisy - truth).reshape(-1) * weight
    inverse = torch.linalg.inv(design.T @ design)
    found = inverse @ (design.T @ off)
    bounces = known.bounces
    state = {"frequencies_hz": (rooms.FREQUENCY,), "light_half_angle_deg": rooms.CONE}
    state |= {"gain": bounces.gain, "gain_interval": [x / rooms.GAIN for x in known.interval]}
    return built(
        camera(),
        TERMS,
        domain,
        coefficients=found,
        covariance=inverse * (off - design @ found).square().mean(),
        noise=(0.0, VARIANCE, 0.0),
        scene={"second_bounces": state},
    )


def class_of(frame: rooms.Frame) -> Image:
    """Numbers of `CLASSES` (H, W)."""
    from scipy.ndimage import maximum_filter, minimum_filter
    from scipy.spatial import KDTree

    distance, known = frame.distance, np.isfinite(frame.distance)
    far, near = np.where(known, distance, -np.inf), np.where(known, distance, np.inf)
    step = maximum_filter(far, 3) - minimum_filter(near, 3)
    result, places = np.zeros(distance.shape, int), distance[..., None] * rooms.rays()
    for number in np.unique(frame.shape[known]):
        own, others = frame.shape == number, known & (frame.shape != number)
        if others.any():
            result[own] = KDTree(places[others]).query(places[own])[0] < NEAR
    result[step > STEP * distance] = CLASSES.index("edge")
    return result


def normalised(correct: DepthCorrector, depth: Any, light: Any, truth: Image) -> Image:  # noqa: ANN401
    """Errors over their standard deviations (H, W); NaN where they are not valid."""
    corrected, valid = correct(depth, light)
    errors = (corrected.numpy() - truth) / correct.uncertainty(depth, light).numpy()
    return np.where(valid.numpy(), errors, np.nan)


def shares(name: str, errors: Iterable[Image]) -> str:
    """One line of the table."""
    every = np.abs(np.concatenate([image[np.isfinite(image)] for image in errors]))
    inside = "".join(f"{100 * np.mean(every < limit):9.1f}" for limit in (1, 2))
    return f"{name:24}{inside}{len(every):9}"


def of_edges(seed: int, count: int) -> None:
    """Print lines of boards and slats with flying pixels."""
    from scipy.ndimage import maximum_filter

    frames = {
        kind: [edges.frame_of(kind, seed + k, 0.35) for k in range(count)]
        for kind in ("boards", "slats")
    }
    every = [frame for own in frames.values() for frame in own]
    depth, light = (
        torch.tensor(np.stack([getattr(frame, name) for frame in every])).float()
        for name in ("distance", "amplitude")
    )
    view = CameraIntrinsics(width=edges.WIDTH, height=edges.HEIGHT, matrix=edges.matrix())
    shown = shown_by(depth, light, view, "radial", FlyingPixelsOptions())
    assert shown is not None, "the frames show flying pixels"
    domain = Domain(height=view.height, width=view.width, radial_distance=Interval(0.1, 7.0))
    nothing = {"coefficients": torch.zeros(1), "covariance": torch.zeros(1, 1)}
    known: dict[str, Any] = {name: value.double() for name, value in nothing.items()}
    scene = {"flying_pixels": shown}
    correct = built(view, [], domain, noise=shown.noise, scene=scene, **known)
    for kind, own in frames.items():
        parts: dict[str, list[Image]] = {"beside flagged": [], "elsewhere": []}
        for frame in own:
            depth, light = (torch.tensor(x).float() for x in (frame.distance, frame.amplitude))
            errors = normalised(correct, depth, light, frame.truth)
            beside = np.asarray(maximum_filter(np.isnan(errors), 3), bool)
            for title, used in zip(parts, (beside, ~beside), strict=True):
                parts[title].append(errors[used])
        for title, found in parts.items():
            print(shares(f"{kind}: {title}", found))


@torch.no_grad()
def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, nargs="+", required=True)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--edges", type=int, default=6, help="frames with flying pixels")
    given = parser.parse_args()
    torch.set_num_threads(1)
    kinds: dict[str, list[Image]] = {name: [] for name in (*rooms.SCENES, *CLASSES)}
    for seed in given.seed:
        correct = calibrated(seed + OTHER_SEED, given.views)
        for name in rooms.SCENES:
            draw = np.random.default_rng(seed + 1)
            for frame in rooms.rendered(name, seed, given.views):
                errors = normalised(correct, *seen(frame, draw), frame.distance)
                kinds[name].append(errors)
                classes = class_of(frame)
                for number, title in enumerate(CLASSES):
                    kinds[title].append(errors[classes == number])
    print(f"{'':24}{'1 sigma':>9}{'2 sigma':>9}{'pixels':>9}")
    for title, found in kinds.items():
        print(shares(title, found))
    print(shares("all", (image for name in rooms.SCENES for image in kinds[name])))
    of_edges(given.seed[0], given.edges)


if __name__ == "__main__":
    main()
