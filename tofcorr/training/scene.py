"""What a corrector removes of the scene's light: what that takes, measured from a recording."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import scripted
from tofcorr.correction.state import CalibrationState, RemainderState, SceneLight
from tofcorr.data.recording import valid_pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import fit_noise
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.options import Options, PositiveNumber
from tofcorr.pixels.dataset import Dataset, thread_number
from tofcorr.pixels.passes import FittedModel, held_out_errors
from tofcorr.pixels.sample import thinned
from tofcorr.scene_light.bounces import (
    Frequencies,
    SecondBounces,
    SecondBouncesOptions,
    SecondBouncesState,
)
from tofcorr.scene_light.drawn import fit_remainder
from tofcorr.scene_light.flying import (
    FlyingPixels,
    FlyingPixelsOptions,
    FlyingPixelsState,
    squared_spreads,
)
from tofcorr.scene_light.gain import Frames, fit_gain
from tofcorr.scene_light.remainder import RemainderOptions
from tofcorr.scene_light.room import Face
from tofcorr.scene_light.stray import StrayLightState
from tofcorr.scene_light.surroundings import large_planes, nearest_plane

_LOG = logging.getLogger(__name__)

ReadFrames = Callable[[], tuple[Tensor, Tensor]]
"""Reads depth, corrected, and amplitude of some frames (B, H, W)."""

_FRAMES = 24
"""Frames that are looked at, evenly spread. Chosen: each has thousands of pixels, and some hundred
at edges."""


class SecondBouncesWanted(SecondBouncesOptions):
    """What is to be removed.

    Attributes:
        frequencies_hz: Modulation frequencies; null: that of the recording.
        gain: One over pi times the amplitude of white paper at 1 m; null: found from the curvature
            that second bounces give to walls.
        budget_ms: Time of a frame on one thread of this machine, the median: patches are made
            larger until a frame keeps to it.
        recorded_room: The room is the large planes of the recordings, put together in the world by
            their poses. It is used beyond the image: they are as bent as those of any frame.
        learned: Train a network on drawn scenes for what the removal leaves, and keep it if it
            helps on others; null: none.
    """

    learned: RemainderOptions | None = None
    frequencies_hz: Frequencies | None = None
    gain: PositiveNumber | None = None
    budget_ms: PositiveNumber | None = None
    recorded_room: bool = False


class RuntimeOptions(Options):
    """What the corrector does in a frame besides correcting every pixel; null: nothing.

    Attributes:
        stray_light: Take this stray light back, before the fit as well. `tofcorr train --with` has
            it from a diagnosis.
        flying_pixels: Find pixels that mix two surfaces.
        second_bounces: Remove light that comes by further surfaces.
    """

    second_bounces: SecondBouncesWanted | None = None
    stray_light: StrayLightState | None = None
    flying_pixels: FlyingPixelsOptions | None = None


def scene_light(data: Dataset, options: RuntimeOptions, state: CalibrationState) -> SceneLight:
    """Return what of the scene's light is to be removed, as recordings show it.

    Args:
        data: The recordings. All pixels are looked at, whether they see the target or not.
        options: What was asked for.
        state: The calibration of the camera.

    Raises:
        CalibrationDataError: Flying pixels are to be found, and there are no amplitudes.
    """
    data, wanted, other = replace(data, direct=None), options.flying_pixels, options.second_bounces
    every = np.arange(data.num_frames)
    frames = cache(lambda: _corrected(data, state, every))  # Read once, and only where needed.
    flying = wanted and _flying_pixels(data, wanted, state, frames)
    bounces = other and _second_bounces(data, other, state, frames)
    return SceneLight(stray_light=options.stray_light, flying_pixels=flying, second_bounces=bounces)


def _second_bounces(
    data: Dataset, wanted: SecondBouncesWanted, state: CalibrationState, frames: ReadFrames
) -> SecondBouncesState:
    """Return what removing second bounces takes, with the gain found where none is given."""
    data.require("amplitude", "removing second bounces (runtime.second_bounces)")
    frequency, recorded = data.first.modulation_frequency, wanted.recorded_room
    values = wanted.model_dump(mode="json", exclude={"learned", "budget_ms", "recorded_room"})
    if recorded:
        values |= {"room": (), "room_axes": "world", "room_in_image": False}
    if wanted.frequencies_hz is None and frequency is None:
        said = "Second bounces need the modulation frequency, which the recording does not state"
        raise CalibrationDataError(f"{said}: set runtime.second_bounces.frequencies_hz.")
    values["frequencies_hz"] = wanted.frequencies_hz or (frequency,)
    if wanted.gain is not None and wanted.budget_ms is None and not recorded:
        return SecondBouncesState.model_validate(values)
    depths, amplitudes = frames()
    if wanted.budget_ms is not None:
        values["gain"] = wanted.gain or 0.0
        values["patch_px"] = patch_within(wanted.budget_ms, values, state, depths, amplitudes)
    radial = depths * DepthCorrector.from_state(state).radial_of_z
    pairs = list(zip(radial, amplitudes, strict=True))
    poses = data.column("world_from_tool")[thinned(np.arange(data.num_frames), _FRAMES)]
    poses = poses @ state.tool_from_camera.cpu()
    if wanted.gain is None:
        values |= _fitted_gain(pairs, poses, values, state)
    if recorded:
        bounces = SecondBounces(state.camera, SecondBouncesState.model_validate(values))
        values["room"] = recorded_room(bounces, pairs, poses)
    return SecondBouncesState.model_validate(values)


def _fitted_gain(
    frames: Frames, poses: Tensor, values: dict[str, Any], state: CalibrationState
) -> dict[str, Any]:
    """Return the gain that is fitted to frames of some poses, and its interval."""
    # Half white, seen straight on, to begin with.
    bright = torch.cat([(d.square() * a).flatten() for d, a in frames]).nanmedian()
    start = values | {"gain": 1 / (2 * math.pi * float(bright))}
    bounces = SecondBounces(state.camera, SecondBouncesState.model_validate(start))
    terms = state.correction().error_model.signal_terms

    def functions(distance: Tensor, amplitude: Tensor) -> Tensor:
        found = [distance[None], *(term.basis(distance, amplitude) for term in terms)]  # type: ignore[operator]
        return torch.cat(found)

    fit = fit_gain(bounces, frames, functions, poses)
    return {"gain": fit.gain, "gain_interval": fit.interval}


def patch_within(
    budget_ms: float, values: dict[str, Any], state: CalibrationState, depth: Tensor, light: Tensor
) -> int:
    """Return the smallest side of a patch, from the usual one on, that keeps to a time a frame.

    It is what one thread computes: what else the machine does counts for nothing.
    """
    options, camera = SecondBouncesState.model_validate(values), state.camera
    patch = options.patch_px or 2 * SecondBounces(camera, options).cell

    def usual() -> float:
        """Return the time of a frame, ms, the median."""
        tried = SceneLight(second_bounces=options.model_copy(update={"patch_px": patch}))
        corrector = scripted(DepthCorrector.from_state(state.model_copy(update={"scene": tried})))
        ends = [time.thread_time()]
        for frame in zip(depth.float()[:7], light.float()[:7], strict=True):
            corrector(*frame)
            ends.append(time.thread_time())
        return 1000 * float(np.median(np.diff(ends)))

    with torch.no_grad(), thread_number(1):
        while (taken := usual()) > budget_ms:
            if patch > max(camera.width, camera.height):
                said = f"{budget_ms:g} ms (runtime.second_bounces.budget_ms): the largest patches"
                said = f"Second bounces cannot be removed in {said} take {taken:.0f} ms."
                raise CalibrationDataError(said)
            # Time goes with the square of the number of patches, at most.
            patch = max(patch + 2, 2 * int(patch * (taken / budget_ms) ** (1 / 4) / 2))
    said = "Removing second bounces: %.0f ms a frame (median), patches of %d pixels."
    _LOG.info(said, taken, patch)
    return patch


def recorded_room(bounces: SecondBounces, frames: Frames, poses: Tensor) -> tuple[Face, ...]:
    """Put the large planes of frames together in the world.

    Args:
        bounces: What finds them.
        frames: That show them.
        poses: World from camera, one of each frame (B, 4, 4).
    """
    ray, parts = bounces.cell_rays.double(), list[tuple[Tensor, Tensor, Tensor]]()
    for (distance, amplitude), pose in zip(frames, poses, strict=True):
        cells = bounces.cells(distance, amplitude)
        _, planes, large = bounces.found(*cells)
        place, _, away, cosine, _ = bounces.surfaces(planes, ray, bounces.solid)
        white = math.pi * bounces.gain * cells[1] * away.square() / cosine
        place = place.T @ pose[:3, :3].T + pose[:3, 3]
        parts.append((place[large], away[large], white[large]))
    place, away, white = (torch.cat(each) for each in zip(*parts, strict=True))
    found = large_planes(place, away, place.new_zeros(0, 4))
    each = [nearest_plane(place, away, found) == number for number in range(len(found))]
    return tuple(Face.around(place[on], min(float(white[on].median()), 1))[0] for on in each)


def with_remainder(options: RuntimeOptions, state: CalibrationState) -> CalibrationState:
    """Return a calibration with a network for what the removal of second bounces leaves.

    Without one where it was not asked for, or does not help on scenes held out.
    """
    wanted, bounces = options.second_bounces, state.scene.second_bounces
    if wanted is None or wanted.learned is None or bounces is None:
        return state
    noise, learned = state.noise or (0.0, 0.0, 0.0), wanted.learned
    _LOG.info("Drawing %d scenes to learn what second bounces leave.", learned.scenes)
    network, errors = fit_remainder(state.camera, bounces, noise, learned)
    left = [round(each, 2) for each in errors]
    helps = left[1] < left[0] and left[3] < left[2]
    _LOG.warning(  # Shown by the commands.
        "Second bounces leave %g mm on scenes held out, with the network %g; "
        "after a plane fit of each surface %g and %g. The network is %s.",
        *(*left, "kept" if helps else "not kept"),
    )
    values = {"left_mm": left[:2], "flat_mm": left[2:], "numbers": network.numbers()}
    found = RemainderState.model_validate({"options": learned, **values})
    return state.model_copy(update={"remainder": found}) if helps else state


def _flying_pixels(
    data: Dataset, wanted: FlyingPixelsOptions, state: CalibrationState, frames: ReadFrames
) -> FlyingPixelsState | None:
    """Measure what finding flying pixels takes; None where there are none."""
    data.require("amplitude", "finding flying pixels (runtime.flying_pixels)")
    depths, amplitudes = frames()
    return shown_by(depths, amplitudes.float(), state.camera, state.depth_kind, wanted)


def scene_summary(
    data: Dataset, runtime: RuntimeOptions, state: CalibrationState, model: FittedModel
) -> dict[str, Any]:
    """Return what of the scene's light is removed, and what that changes in frames held out.

    Of stray light and second bounces it is the RMS error to the target, mm, as recorded and without
    that light; of flying pixels their share of all pixels, None where the recording shows none.

    Args:
        data: The recordings, with or without the light that is removed.
        runtime: What was asked for.
        state: The calibration, with what was found.
        model: The fitted model, and the frames held out.
    """
    found, summary = state.scene_mapping(), dict[str, Any]()
    stray = replace(data, stray=None), data.without_stray_light(state.scene.stray_light)
    straight = data if data.direct is not None else data.without_second_bounces(state)
    direct = replace(data, direct=None), straight
    for name, sets in (("stray_light", stray), ("second_bounces", direct)):
        if found[name] is not None:
            errors = [held_out_errors(each, [model])[0]["to_plane"].rms_mm() for each in sets]
            summary[name] = found[name] | {"held_out_rms_mm": errors}
    if runtime.flying_pixels is not None:
        share, finder = None, state.flying_pixels()
        if finder is not None:
            plain = state.model_copy(update={"scene": SceneLight()})
            depths, amplitudes = _corrected(direct[1], plain, model.held_out)
            flying, _ = finder.found(depths, amplitudes)
            share = float(flying.sum() / depths.isfinite().sum())
        summary["flying_pixels"] = (found["flying_pixels"] or {}) | {"held_out_share": share}
    return summary | {name: found[name] for name in ("learned",) if name in found}


def _corrected(data: Dataset, state: CalibrationState, frames: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return depth, corrected, and amplitude of some of frames (B, H, W); NaN where not usable."""
    corrector, images = DepthCorrector.from_state(state), []
    for batch in data.batches(thinned(frames, _FRAMES)):
        assert batch.amplitude is not None
        depth, amplitude = batch.radial_distance / corrector.radial_of_z, batch.amplitude
        usable = valid_pixels(depth, amplitude, None, state.saturation_amplitude)
        with torch.no_grad():
            corrected, _ = corrector(depth.float(), amplitude.float())
        images.append((corrected.where(usable, torch.nan), amplitude.where(usable, torch.nan)))
    depths, amplitudes = (torch.cat(kind) for kind in zip(*images, strict=True))
    return depths, amplitudes


@torch.no_grad()
def shown_by(
    depth: Tensor,
    amplitude: Tensor,
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
    wanted: FlyingPixelsOptions,
) -> FlyingPixelsState | None:
    """Measure point spread and noise of frames; None if they have no edges, or no flying pixels.

    Args:
        depth: Of the camera's kind, corrected, shape (B, H, W), metres; NaN: not to be used.
        amplitude: The camera's units, the same shape; NaN: not to be used.
        camera: The lateral parameters.
        depth_kind: What depth means.
        wanted: What was asked for.
    """
    spreads = torch.cat([squared_spreads(one[None]) for one in amplitude])
    if len(spreads) < len(depth):  # Not an edge a frame.
        return None
    spread = float(spreads.median().clamp(min=0).sqrt())
    values = wanted.to_mapping() | {"point_spread_px": spread}
    finder = FlyingPixels(camera, depth_kind, FlyingPixelsState(**values, noise=(0.0, 0.0, 0.0)))
    # `fit_noise` takes differences of two pixels.
    off = torch.cat([finder.departures(one[None]) for one in depth]) * 2**0.5
    noise = fit_noise(off.flatten(), amplitude.flatten(), "neighbours")[:3]
    shown = FlyingPixelsState(**values, noise=noise)
    finder = FlyingPixels(camera, depth_kind, shown)
    flying = sum(int(finder.found(*one)[0].sum()) for one in zip(depth, amplitude, strict=True))
    return shown if flying > wanted.false_alarm * int(depth.isfinite().sum()) else None
