"""Frames that any simulator rendered, written as a recording."""

from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.given.checks import refuse_other_camera, refuse_without_truth
from tofcorr.diagnosis.given.elsewhere import simulated_elsewhere
from tofcorr.diagnosis.given.geometry_checks import refuse_mistaken_geometry
from tofcorr.diagnosis.given.matching import Matches, match_frames, repeats_of
from tofcorr.diagnosis.given.simulator import GivenSimulator, Simulated
from tofcorr.diagnosis.given.true_depth import has_true_depth
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.noise_estimate import estimate_noise
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.diagnosis.sums.pixel_noise import PixelNoise
from tofcorr.diagnosis.sums.simulator_error import SimulatorError
from tofcorr.geometry.planes import distance_along_rays
from tofcorr.geometry.rays import ray_directions


class RenderedSimulator(GivenSimulator):
    """A recording that a simulator rendered; its hand-eye transform and its planes are exact.

    Args:
        recording: The rendered frames.
    """

    kind = "rendered"

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    def rendered_frames(self, recording: Recording) -> Recording:
        """Return the rendered frames, whichever poses they show."""
        del recording
        return self.recording

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> Simulated:
        """Compare pixel by pixel at the same poses; at others, through the covariates."""
        refuse_other_camera(observations.recording, self.recording)
        frames = observe(self.recording, options.most_pixels)
        if self.recording.frames.pose_id is None:
            frames = replace(frames, unit=torch.from_numpy(repeats_of(self.recording)))
        if not has_true_depth(self.recording):
            refuse_without_truth(self.recording, frames)
            refuse_mistaken_geometry(self.recording)
        pose = torch.from_numpy(self.recording.tool_from_camera)
        noise = estimate_noise(frames, pose)
        matches = match_frames(observations.recording, self.recording)
        if not matches.enough:
            return simulated_elsewhere(frames, observations, options)
        error, sigma = _pixel_by_pixel(frames, noise, matches, observations)
        known = SimulatorError(
            error=error,
            sigma=sigma,
            tool_from_camera=pose,
            uncertain=error.new_zeros(len(error), 0),
        )
        return Simulated(error=known, warnings=_unmatched(self.recording, matches))


def _pixel_by_pixel(
    frames: Observations, noise: PixelNoise, matches: Matches, real: Observations
) -> tuple[Tensor, Tensor]:
    """Return the mean error of the renders in each chosen pixel, and its standard deviation, (M,).

    The truth of a render is the plane at the render's own pose, so that a pose that was rounded
    differently changes nothing.
    """
    pose = torch.from_numpy(frames.recording.tool_from_camera)
    world_from_camera = frames.facts.world_from_tool @ pose
    rays = ray_directions(frames.recording.camera).reshape(-1, 3)
    usable = _usable(frames)
    error = torch.full_like(real.measured, torch.nan)
    sigma = torch.zeros_like(real.measured)
    for frame, (start, end) in enumerate(real.frame_ends):
        renders = torch.from_numpy(matches.renders[frame])
        if end == start or len(renders) == 0:
            continue
        pixel = real.pixel[start:end].repeat(len(renders))
        source = renders.repeat_interleave(end - start)
        truth = distance_along_rays(
            rays[pixel], source, world_from_camera, frames.facts.normal_world, frames.facts.offset
        )
        simulated = frames.distance_images.flatten(1)[source, pixel].double()
        use = usable.flatten(1)[source, pixel] & (truth > 0)
        spread = noise.at(_brightness(frames, source, pixel, simulated), source)
        shape = (len(renders), end - start)
        count = use.reshape(shape).sum(0)
        total = torch.where(use, simulated - truth, 0.0).reshape(shape).sum(0)
        squares = torch.where(use, spread**2, 0.0).reshape(shape).sum(0)
        error[start:end] = total / count  # 0 / 0: no render shows this pixel.
        sigma[start:end] = (squares.sqrt() / count).nan_to_num(0.0)
    return error, sigma


def _usable(frames: Observations) -> Tensor:
    """Return where the rendered frames show the target, shape (F, H, W), bool."""
    usable = frames.on_target & (frames.distance_images > 0)
    full = frames.recording.saturation_amplitude
    if full is not None and frames.amplitude_images is not None:
        usable &= frames.amplitude_images < full
    return usable


def _brightness(frames: Observations, source: Tensor, pixel: Tensor, distance: Tensor) -> Tensor:
    """Return what the noise depends on, as `brightness_of` does for chosen pixels."""
    if frames.amplitude_images is not None:
        return frames.amplitude_images.flatten(1)[source, pixel].double()
    return 1.0 / distance.clamp(min=1e-3) ** 2


def _unmatched(recording: Recording, matches: Matches) -> tuple[str, ...]:
    if not matches.missing:
        return ()
    return (
        f"{recording.path}: {matches.missing} of {len(matches.renders)} recorded frames were not "
        "rendered (no pose within 1 mm and 1 mrad); they are left out.",
    )
