"""How far a found sensor closes the gap: degraded ideal frames against real ones, held out.

    python -m benchmarks.degraded_gap RECORDING [--ideal IDEAL] [--config NAME] [--seeds 1]

Half of the poses are diagnosed; the sensor that this gives degrades ideal frames of the other half.
`<= 1.1`: degraded frames leave at most 1.1 times the stage with effects; `open`: more, but not
significantly (one-sided, 5 %). `withheld pairs` asks the same where the truth is known.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
import torch
from scipy.stats import norm
from torch import Tensor

from benchmarks.sealed.scores import table
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.findings.gap import resampled
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.checks import excess_gaps
from tofcorr.diagnosis.rerun.sensor import expected_images, light_images, sensor_of
from tofcorr.diagnosis.rerun.simulator import solution_of
from tofcorr.diagnosis.sums.noise import (
    FLOOR_ERROR,
    brightness_of,
    common_of_neighbours,
    estimate_noise,
    gap_weight,
    robust_weights,
)
from tofcorr.diagnosis.sums.observations import Observations, distance_images, effect_inputs
from tofcorr.diagnosis.sums.observations import observe as observe_pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import radial_distance_from_z_depth, ray_directions
from tofcorr.observables.dropouts import dropouts_of
from tofcorr.observables.noise import noise_of
from tofcorr.observables.read import observe, pose_groups
from tofcorr.options import resolve_options
from tofcorr.sensor.degrade import degrade
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile


def halves(recording: Recording, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames of a random half of the poses, and those of the other half."""
    groups = pose_groups(recording)
    order = np.random.default_rng(seed).permutation(len(groups))
    parts = order[: (len(groups) + 1) // 2], order[(len(groups) + 1) // 2 :]
    first, second = (np.sort(np.concatenate([groups[k] for k in part])) for part in parts)
    return first, second


def written(
    recording: Recording, frames: np.ndarray, path: Path, depth: Tensor | None = None
) -> Recording:
    """Write some frames of a recording as one of their own, with other depth (F, H, W) if given."""
    names = ("depth", "amplitude", "mask")
    with RecordingWriter.with_header_of(path, recording) as writer:
        for place, number in enumerate(frames.tolist()):
            read = {name: recording.read(name, np.array([number])) for name in names}
            images: dict[str, Any] = {k: None if one is None else one[0] for k, one in read.items()}
            if depth is not None:
                images["depth"] = depth[place].numpy()
            writer.append(images.pop("depth"), row=recording.frames.row(number), **images)
    return Recording.open(path, check_contents=False)


def excess_over(
    observations: Observations,
    sigma: Tensor,
    floor_factor: float,
    counted: Tensor,
    depth: Tensor,
    resamples: Tensor | None = None,
) -> Tensor:
    """Return the gap of measured to simulated distances, and of resamples of the poses, metres.

    Args:
        observations: The M pixels.
        sigma: Standard deviation of their noise, (M,), metres.
        floor_factor: So much larger is the noise of a gap.
        counted: Which count, (M,).
        depth: The simulated images (F, H, W), of the recording's kind.
        resamples: How often each holds each pose, (B, U).
    """
    simulated = radial_at(observations, depth)
    known = simulated.isfinite() & (simulated > 0) & counted
    residual = torch.where(known, observations.measured - simulated, 0.0)
    trust = robust_weights(residual, sigma, common_of_neighbours(observations, residual))
    share = trust * gap_weight(sigma) * known
    return excess_gaps(observations, residual, share, floor_factor * sigma, resamples)


def radial_at(observations: Observations, depth: Tensor) -> Tensor:
    """Return the distances of the chosen pixels in depth images (F, H, W), (M,), metres."""
    recording = observations.recording
    if recording.depth_kind == "z":
        depth = radial_distance_from_z_depth(depth, ray_directions(recording.camera))
    return depth.reshape(len(depth), -1)[observations.frame, observations.pixel].double()


@dataclass(frozen=True, kw_only=True)
class DegradedGap:
    """Real against ideal and degraded frames, at poses held out from everything; metres.

    Attributes:
        ideal: Gap of the ideal frames: root mean square of real minus ideal, less the noise.
        degraded: The same of the degraded frames: what remains.
        degraded_interval: Its 95 % interval, with poses as the unit.
        with_effects: The gap with effects that the diagnosis of the other poses states.
        noise: Standard deviation of the temporal noise: real, degraded.
        dropouts: Share of missing pixels on the target: real, degraded.
        sensor: What was found at the other poses.
        diagnosis: Of those poses.
        poses: Number of poses held out.
        covered_share: Share of their pixels within the distances and amplitudes of the other
            poses. Gaps are of these: beyond, the sensor is not measured.
    """

    ideal: float
    degraded: float
    degraded_interval: tuple[float, float]
    with_effects: float
    noise: tuple[float, float]
    dropouts: tuple[float, float]
    sensor: SensorFile
    diagnosis: DiagnosisResult
    poses: int
    covered_share: float

    def within(self, most: float) -> bool | None:
        """Return whether what remains is at most so many times what the stage states.

        Squares are compared, for these have normal errors: those of the poses on either side, and
        5 % of the noise floor in each half.

        Args:
            most: The factor.

        Returns:
            None: it is more, but by less than the data resolve (one-sided, 5 %).
        """
        stage, floor = self.diagnosis.gap, self.diagnosis.gap.floor
        excess = self.degraded**2 - (most * self.with_effects) ** 2
        errors = [2 * FLOOR_ERROR * floor**2, 2 * FLOOR_ERROR * (most * floor) ** 2]
        for factor, (low, high) in ((1, self.degraded_interval), (most**2, stage.after.interval)):
            errors.append(factor * (high**2 - low**2) / (2 * float(norm.ppf(0.975))))
        if excess <= 0:
            return True
        return None if excess <= norm.ppf(0.95) * math.hypot(*errors) else False


def degraded_gap(
    real: Recording,
    config: DiagnosisOptions | Mapping[str, Any] | Path | str | None = None,
    *,
    ideal: Recording | None = None,
    seed: int = 0,
    resamples: int = 400,
) -> DegradedGap:
    """Diagnose half of the poses, degrade ideal frames of the other half, and compare.

    Args:
        real: The real recording.
        config: Options of the diagnosis; None: the defaults.
        ideal: Ideal frames at all poses of `real`, in its order; None: the planes of `real`, seen
            with the hand-eye transform that the diagnosed half gives.
        seed: Of the halves and of all draws.
        resamples: Of the poses, behind the interval.

    Raises:
        CalibrationDataError: `ideal` has other frames, or half of the poses is too few.
    """
    options = DiagnosisOptions() if config is None else resolve_options(DiagnosisOptions, config)
    options = options.model_copy(update={"simulate_anew": False, "page": False})
    if ideal is not None and ideal.num_frames != real.num_frames:
        raise CalibrationDataError(
            f"{ideal.path}: has {ideal.num_frames} frames, {real.path} has {real.num_frames}; "
            "expected one ideal frame for each real one."
        )
    shown, held = halves(real, seed)
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        found = diagnose(written(real, shown, scratch / "shown"), None, options)
        rest = written(real, held, scratch / "held")
        observations = observe_pixels(rest, options.most_pixels)
        study, named = found.evidence.study, found.evidence.named
        pose = solution_of(study, named)[0]
        slant = ray_directions(real.camera)[..., 2] if real.depth_kind == "z" else torch.ones(1)
        if ideal is None:
            # On the target that is the plane; off it only the real camera knows what is there.
            depth = (distance_images(observations, pose, slice(None)) * slant).float()
            mounted = replace(rest, tool_from_camera=pose.numpy())
        else:
            exact = ideal.read("depth" if ideal.true_depth is None else "true_depth", held)
            depth, mounted = torch.as_tensor(exact), rest
        perfect = written(mounted, np.arange(len(held)), scratch / "ideal", depth)
        sensor = sensor_of(study, named, found.simulator, found.observables)
        model = SensorModel(sensor)
        degraded = degrade(model, perfect, scratch / "degraded", seed=seed).recording
        light = light_images(model, observations, effect_inputs(observations, pose))
        distance = expected_images(model, real, torch.from_numpy(held), depth / slant, light)
        noise = estimate_noise(observations, pose)
        sigma = noise.at(brightness_of(observations), observations.frame)
        covered = model.base.covers(radial_at(observations, depth), observations.amplitude)
        counted = (observations, sigma, found.gap.floor / study.fit.floor, covered)
        generator = torch.Generator().manual_seed(seed)
        drawn = resampled(observations.num_units, resamples, generator)
        remains, gaps = excess_over(*counted, distance * slant, drawn).split([1, len(drawn)])
        low, high = gaps.quantile(torch.tensor([0.025, 0.975], dtype=gaps.dtype)).tolist()
        both = [observe(each) for each in (rest, degraded)]
        return DegradedGap(
            ideal=float(excess_over(*counted, depth)),
            degraded=float(remains),
            degraded_interval=(low, high),
            with_effects=found.gap.after,
            noise=(noise_of(both[0]).temporal_m, noise_of(both[1]).temporal_m),
            dropouts=(dropouts_of(both[0]).share, dropouts_of(both[1]).share),
            sensor=sensor,
            diagnosis=found,
            poses=observations.num_units,
            covered_share=float(covered.double().mean()),
        )


HEAD = (
    *("recording, seed", "poses held out", "ideal, mm", "with effects, mm", "degraded, mm"),
    *("<= 1.1", "noise, mm", "degraded", "missing pixels", "degraded", "covered", "named"),
)


def line(name: str, found: DegradedGap, most: float = 1.1) -> tuple[object, ...]:
    """Return a row of the table."""
    within = {True: "yes", None: "open", False: "no"}[found.within(most)]
    gaps = (found.ideal, found.with_effects, found.degraded, *found.degraded_interval)
    ideal, stage, *degraded = (f"{1e3 * gap:.2f}" for gap in gaps)
    return (
        *(name, found.poses, ideal, stage, "{} [{}, {}]".format(*degraded), within),
        *(f"{1e3 * noise:.2f}" for noise in found.noise),
        *(f"{share:.4f}" for share in (*found.dropouts, found.covered_share)),
        ", ".join(found.diagnosis.effects),
    )


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--ideal", type=click.Path(path_type=Path), help="Ideal frames of its poses.")
@click.option("--config", default="default", show_default=True, help="Of the diagnosis.")
@click.option("--seeds", multiple=True, type=int, default=[1], help="May be repeated.")
def main(recording: Path, ideal: Path | None, config: str, seeds: tuple[int, ...]) -> None:
    """Print how far a found sensor closes the gap: a row for every seed."""
    real, perfect = Recording.open(recording), None if ideal is None else Recording.open(ideal)
    found = {seed: degraded_gap(real, config, ideal=perfect, seed=seed) for seed in seeds}
    click.echo(table(HEAD, [line(f"{recording.name}, {k}", one) for k, one in found.items()]))


if __name__ == "__main__":
    main()
