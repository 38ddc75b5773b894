"""The page of a training: one HTML file that needs nothing else, the verdict first."""

import base64
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.digits import in_mm, with_interval
from tofcorr.error_terms.model import Pixels
from tofcorr.estimation.robust import student_quantile, without_strays
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame, ray_plane_distance
from tofcorr.pages.page import page_text, resource
from tofcorr.pixels.sample import PixelSample, draw_pixels
from tofcorr.training.calibration import Calibration
from tofcorr.training.figures import (
    frames_to_show,
    hand_eye_figure,
    image_figure,
    poses_figure,
    profile,
    profile_figure,
    residual_figure,
)
from tofcorr.training.judgement import (
    advice_words,
    left_out_words,
    outlying_words,
    scene_words,
    stage_words,
    update_words,
)

if TYPE_CHECKING:  # Matplotlib takes longer to import than a short fit.
    from matplotlib.figure import Figure


def draw_figures(
    report: Mapping[str, Any],
    calibration: Calibration,
    sample: PixelSample,
    found: Mapping[str, Any],
) -> dict[str, "Figure"]:
    """Return the pictures of a training by their names on the page; arguments as for `render`."""
    data, camera = calibration.data, calibration.data.first.camera
    advised = [one["world_from_tool"] for one in (report["advice"] or {"poses": []})["poses"]]
    poses = torch.tensor(advised if data.moves else [], dtype=torch.float64).view(-1, 4, 4)
    figures = {
        "frame": residual_figure(calibration, np.array([typical_frame(calibration)])),
        "poses": poses_figure(calibration, poses, found["correction_curves"]["distance"]),
        "covariates": profile_figure(sample, shown_covariates(sample), calibration.test),
        "image": image_figure(sample, (camera.height, camera.width)),
    }
    if report["hand_eye"]["estimated"]:
        freedom = calibration.fit.covariance.degrees_of_freedom
        figures["hand_eye"] = hand_eye_figure(report["hand_eye"], freedom)
    return figures


def shown_covariates(sample: PixelSample) -> list[str]:
    """Return the two covariates that the page shows: distance and amplitude, else incidence."""
    wanted = "distance [m]", "amplitude [camera's units]", "angle of incidence [degrees]"
    return [name for name in wanted if name in sample.covariates][:2]


def typical_frame(calibration: Calibration) -> int:
    """Return the global number of a frame in the middle by its error, held out where one is."""
    order = frames_to_show(calibration)
    held_out = order[np.isin(order, calibration.test)]
    chosen = held_out if len(held_out) else order
    return int(chosen[len(chosen) // 2])


def render(
    report: Mapping[str, Any],
    calibration: Calibration,
    sample: PixelSample,
    found: Mapping[str, Any],
    figures: Mapping[str, "Figure"],
) -> str:
    """Return the page of a training.

    Args:
        report: The content of report.json.
        calibration: The fitted model and its errors.
        sample: Pixels of all frames used.
        found: The content of calibration.yaml.
        figures: Its pictures, see `draw_figures`.
    """
    data, frame = calibration.data, typical_frame(calibration)
    factor = student_quantile(39 / 40, calibration.fit.covariance.degrees_of_freedom)
    errors = {k: own.rms_mm(np.array([frame])) for k, own in calibration.errors.items()}
    return page_text(
        "tofcorr.training",
        "report.html.j2",
        figures,
        {"mm": in_mm, "with_interval": with_interval, "stage": stage_words},
        report=report,
        updated=update_words(report),
        scene=scene_words(report),
        direct=data.direct is not None or data.stray is not None,
        advised=report["advice"] and advice_words(report["advice"]),
        names=[recording.path.name for recording in data.recordings],
        frame={"number": frame, "target": data.targets[frame], "tested": frame in calibration.test}
        | errors,
        cloud=json.dumps(cloud(calibration, frame)),
        script=resource("tofcorr.pages", "cloud.js"),
        reach={name: _reach(sample, name) for name in shown_covariates(sample)},
        found=found,
        coefficients=[
            (group, symbol, one["value"], factor * (one["standard_error"] or 0.0))
            for group, named in found["coefficients"].items()
            for symbol, one in named.items()
            if one["value"] is not None
        ],
        said=[
            *left_out_words([one["frame"] for one in report["left_out"]]),
            *outlying_words(report["outlying_images"]),
        ],
    )


def cloud(calibration: Calibration, frame: int, most: int = 12_000) -> dict[str, Any]:
    """Return points of a frame before and after correction, and its wall, for `cloud.js`.

    All are in the camera's frame after the calibration, so that the wall stands still.

    Args:
        calibration: The fitted model and its errors.
        frame: Its global number.
        most: How many points of each stage are shown: drawn at random where there are more.
    """
    data, fitted = calibration.data, calibration.stages["after"].hand_eye().detach()
    drawn, shown, errors = draw_pixels(data, np.array([frame]), most, seed=0), {}, {}
    for stage in ("before", "after"):
        points, error = corrected_points(calibration, stage, drawn.pixels, drawn.ray)
        hand_eye = calibration.stages[stage].hand_eye().detach()
        onto = se3.inverse(fitted) @ hand_eye
        off = drawn.distance_to_plane(hand_eye, error) / drawn.cosine(hand_eye)
        moved = points @ onto[:3, :3].T + onto[:3, 3]
        rows = torch.cat([moved, 1e3 * off[:, None]], dim=1).numpy().astype("<f4")
        shown[stage] = base64.b64encode(rows.tobytes()).decode("ascii")
        errors[stage] = rows[:, 3]
    plane = plane_in_frame(drawn.normal_tool[0], drawn.offset_tool[0], fitted)
    corners = data.ray_directions()[[0, 0, -1, -1], [0, -1, -1, 0]]
    wall = corners * ray_plane_distance(corners[None], *plane)[0][:, None]
    low, high = without_strays(errors["before"])
    return {"clouds": shown, "wall": wall.tolist(), "limit": max(abs(low), abs(high)) or 1.0}


def corrected_points(
    calibration: Calibration, stage: str, pixels: Pixels, rays: Tensor
) -> tuple[Tensor, Tensor]:
    """Return points (M, 3) in the camera's frame at a stage, and the errors taken off (M,), metres.

    Args:
        calibration: The fitted model.
        stage: One of its stages.
        pixels: M pixels.
        rays: Their unit rays, shape (M, 3).
    """
    with torch.no_grad():
        error = calibration.stages[stage].error.error_at(pixels)
    return rays * (pixels.radial_distance - error)[:, None], error


def _reach(sample: PixelSample, covariate: str) -> dict[str, float]:
    """Return the largest mean error over a covariate before and after correction, mm."""
    x = sample.covariates[covariate]
    found = {name: profile(x, one, without_strays(x))[1] for name, one in sample.errors_mm.items()}
    return {name: float(np.nanmax(np.abs(mean), initial=0.0)) for name, mean in found.items()}
