"""A camera as an `nn.Module`: from true depth to what that camera measures."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from kornia.filters import filter2d_separable
from torch import Tensor, nn

from tofcorr.error_terms.base import EVERYTHING, DescribedModule, Domain, Interval
from tofcorr.error_terms.condition_terms import Condition, with_means
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.estimation.noise import NoiseModel
from tofcorr.files import write_text
from tofcorr.scene_light.bounces import SecondBounces
from tofcorr.scene_light.surroundings import Surroundings, added_around
from tofcorr.sensor.scene import Eye, Group, ImageEffects, SceneFrames, conditions_of
from tofcorr.sensor.sensor_file import ErrorSection, SensorFile, read_sensor, sensor_text

# How often the measured distance is put into its own error. Each time the deviation is multiplied
# by the slope of the error, 0.05 at most: after 3 times 6e-6 of the error is left. Derived.
_ITERATIONS = 3


class BaseError(nn.Module):
    r"""Error of the measured distance: constant and error terms.

    .. math:: D = D_\mathrm{true} + E(x, I, r, c, \text{conditions})

    where x is the true or the measured distance, as the sensor says. Distance and amplitude are
    held to the ranges that the sensor was measured in.

    Args:
        section: Terms and coefficients.
        domain: Image size and ranges.
        true: Range of true distances, metres; None: those whose measured ones fill the range.

    Attributes:
        model: The terms; their coefficients are the parameters.
        needs_amplitude: Whether a term reads the amplitude.
    """

    mean_conditions: Tensor

    def __init__(self, section: ErrorSection, domain: Domain, true: Interval | None) -> None:
        super().__init__()
        self.reads_measured = section.reads == "measured_distance"
        self.model = error_model_of(section, domain)
        self.needs_amplitude = self.model.needs_amplitude()
        self.domain = domain
        self.limits = self.model.limits(domain)
        if not self.reads_measured:
            true = true or self._true_range(domain)
            self.limits = replace(self.limits, radial_distance=true)
        means = torch.tensor(domain.mean_conditions(), dtype=torch.float64)
        self.register_buffer("mean_conditions", means)

    @torch.no_grad()
    def _true_range(self, domain: Domain) -> Interval:
        """Return the true distances whose measured ones fill the range, in any pixel and light."""
        lights = (self.limits.amplitude if self.needs_amplitude else None) or Interval(1.0, 1.0)
        ends = []
        for distance in domain.radial_distance:
            like = self.model.constant.new_full((domain.height, domain.width), distance)
            ends.append([self.model(like, torch.full_like(like, light)) for light in lights])
        (near, far), (low, high) = (torch.stack(end) for end in ends), domain.radial_distance
        return Interval(low - float(near.max()), high - float(far.min()))

    def forward(self, true: Tensor, amplitude: Tensor, conditions: Tensor | None) -> Tensor:
        """Return measured minus true distance, shape (..., H, W), metres.

        Args:
            true: True distances along the ray, shape (..., H, W), metres, all finite.
            amplitude: The camera's units, the same shape; any values if no term reads them.
            conditions: Shape (..., C) or (C,); None: the mean conditions.
        """
        fixed = self.model.pixel_error()
        if conditions is not None and len(self.model.condition_terms):
            fixed = fixed + self.model.condition_error(conditions)[..., None, None]
        held = amplitude.clamp(*(self.limits.amplitude or EVERYTHING))
        bounds = self.limits.normalised_amplitude or EVERYTHING
        error = torch.zeros_like(true)
        for _ in range(1 + _ITERATIONS if self.reads_measured else 1):
            distance = (true + error).clamp(*self.limits.radial_distance)
            error = fixed + self.model.signal_error(distance, held, bounds)
        return error.expand(true.shape)


def error_model_of(section: ErrorSection, domain: Domain) -> ErrorModel:
    """Build the error model of a file's section.

    Raises:
        ConfigError: A coefficient is missing.
    """
    model = ErrorModel(ErrorModelOptions(terms=section.terms), domain)
    groups = _each(section.coefficients, lambda value: math.nan if value is None else value)
    try:
        model.set_paper_coefficients(groups)
    except KeyError as error:
        said = f"error.coefficients lack {error}, which a term of error.terms has"
        raise ConfigError(f"sensor: {said}.") from None
    return model


def section_of(model: ErrorModel, section: ErrorSection) -> ErrorSection:
    """Return a section with the coefficients that a model has now."""
    groups = _each(model.paper_coefficients(), lambda value: None if math.isnan(value) else value)
    return section.model_copy(update={"coefficients": groups})


def _each(groups: Mapping[str, Mapping[str, Any]], change: Callable[[Any], Any]) -> dict[str, Any]:
    """Return coefficients by group and symbol, each of them changed."""
    return {g: {name: change(v) for name, v in named.items()} for g, named in groups.items()}


class SensorNoise(nn.Module):
    r"""Noise along the ray, :math:`\sigma(A) \epsilon`, with the sigma of `NoiseModel`.

    :math:`\epsilon` has variance 1 and is correlated between neighbours; a share of its variance is
    the same in every frame. Differentiable in f, s, r, distance and amplitude.

    Args:
        section: The numbers.
        size: Height and width of the image.

    Attributes:
        deviations: f, s and r, shape (3,), metres; any sign.
        needs_amplitude: Whether the noise depends on the amplitude.
    """

    fixed: Tensor
    kernel: Tensor

    def __init__(self, section: NoiseModel, size: tuple[int, int]) -> None:
        super().__init__()
        self.section, self.needs_amplitude = section, section.needs_amplitude
        self.deviations = nn.Parameter(torch.tensor(section.deviations, dtype=torch.float64))
        width = section.correlation_px
        # A Gaussian filter that keeps the variance of white noise; 0.006 % of it lies beyond 4.
        reach = max(1, math.ceil(4 * width)) if width > 0 else 0
        at = torch.arange(-reach, reach + 1, dtype=torch.float64)
        weights = torch.exp(-0.5 * (at / (width or 1.0)) ** 2)
        self.register_buffer("kernel", weights / weights.norm())
        camera = torch.Generator().manual_seed(section.fixed_seed)
        self.register_buffer("fixed", self._drawn(torch.zeros(size, dtype=torch.float64), camera))

    def sigma(self, distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the standard deviation along the ray, as `NoiseModel.sigma` does."""
        return self.section.sigma(distance, amplitude, self.deviations.unbind())

    def draw(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw noise of standard deviation 1, shape (..., H, W), dtype and device of `like`."""
        share, noise = self.section.fixed_share, self._drawn(like, generator)
        if share == 0:
            return noise
        return math.sqrt(1 - share) * noise + math.sqrt(share) * self.fixed.to(like.dtype)

    def to_section(self) -> NoiseModel:
        """Return the numbers of now."""
        floor, shot, read = self.deviations.detach().abs().tolist()
        return self.section.model_copy(update={"floor_m": floor, "shot_m": shot, "read_m": read})

    def _drawn(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw noise that is the same in no two frames, as `draw` does."""
        reach = self.kernel.numel() // 2
        height, width = like.shape[-2:]
        size = (like[..., 0, 0].numel(), height + 2 * reach, width + 2 * reach)
        drawn = torch.randn(size, generator=generator, dtype=like.dtype, device=like.device)
        line = self.kernel.to(like.dtype)[None]
        return filter2d_separable(drawn[:, None], line, line, padding="valid").reshape(like.shape)


class SensorWarning(UserWarning):
    """An effect of a sensor was left out, because the images do not hold what it needs."""


class Measurement(NamedTuple):
    """What a camera measures, each of shape (..., H, W).

    Attributes:
        depth: Of the camera's kind, metres; NaN where there is no distance.
        amplitude: The camera's units; None if neither amplitude nor reflectivity is known.
        valid: Where there is a distance and the pixel is not saturated, bool.
    """

    depth: Tensor
    amplitude: Tensor | None
    valid: Tensor


class Around(NamedTuple):
    """What stands around the camera of some frames, also beside what they show.

    Attributes:
        surroundings: Large planes.
        world_from_camera: Pose of each frame (B, 4, 4), in the axes of the planes.
    """

    surroundings: Surroundings
    world_from_camera: Tensor

    def of(self, frames: slice) -> Self:
        """Return the same for some of the frames."""
        return self._replace(world_from_camera=self.world_from_camera[frames])


class SensorModel(DescribedModule):
    r"""Turns true depth of any scene into what one camera measures.

    .. math:: D = D_\mathrm{true} + E(D, A, r, c) + \Delta d_\mathrm{effects} + \sigma(A)\,\epsilon

    The expected measurement is differentiable in depth, amplitude and every parameter: the error
    terms' coefficients, the effects' coefficients, and the noise's deviations. The noise is
    reparameterised, so that its draws only scale the gradient. Missing pixels are drawn: they have
    no gradient.

    The module computes in the dtype of its parameters (`load` gives float32: rounding then changes
    a distance by a few micrometres) and returns that of the input. It runs where its parameters
    are.

    Args:
        sensor: The camera as it was found.
        dtype: Of parameters and buffers.

    Attributes:
        base: Constant and error terms.
        effects: Effects beyond them.
        bounces: What adds second bounces of light; None: nothing does.
        noise: None if unknown.
        dropouts: None if unknown.
        left_out: Effects that no depth image can show, and why, a sentence each.

    Raises:
        ConfigError: An effect or a coefficient is wrong.

    Shape:
        - Input: `(..., H, W)`, depth of the camera's kind in metres, amplitude or reflectivity.
        - Output: `(..., H, W)` three times.

    Example:
        >>> import torch, tofcorr
        >>> sensor = tofcorr.SensorModel.load("kinect_v2")
        >>> depth = torch.full((424, 512), 1.2)
        >>> generator = torch.Generator().manual_seed(1)
        >>> measured = sensor(depth, reflectivity=0.6 * torch.ones_like(depth), generator=generator)
        >>> bool((measured.depth[measured.valid] != 1.2).all())
        True
    """

    def __init__(self, sensor: SensorFile, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.sensor = sensor
        camera = sensor.intrinsics()
        self.eye = Eye(sensor)
        true = sensor.validity.true_radial_distance_m
        self.base = BaseError(sensor.error, sensor.domain(), true and Interval(*true))
        self.effects = ImageEffects(camera, sensor.effects, sensor.modulation_frequency_hz)
        size = (camera.height, camera.width)
        self.noise = None if sensor.noise is None else SensorNoise(sensor.noise, size)
        self.dropouts, bounces = sensor.dropouts, sensor.second_bounces
        self.bounces = None if bounces is None else SecondBounces(camera, bounces)
        self._half_angle = None if bounces is None else bounces.light_half_angle_deg
        self._ranges = self.base.domain.conditions
        self._said: set[str] = set()
        self.to(dtype)
        self.left_out = tuple(self.effects.left_out)
        self._say(self.left_out)

    @classmethod
    def load(cls, sensor: str | Path, dtype: torch.dtype = torch.float32) -> Self:
        """Build the model of a shipped sensor such as `"kinect_v2"`, or of a `sensor.yaml`.

        The folder of a diagnosis, which holds a `sensor.yaml`, will do as well.

        Raises:
            ConfigError: There is none, or it breaks the format.
        """
        return cls(read_sensor(sensor), dtype)

    def save(self, file: Path | str) -> None:
        """Write a `sensor.yaml` with the parameters of now, whole or not at all.

        Raises:
            ExportError: The file cannot be written.
        """
        write_text(file, sensor_text(self.to_sensor_file()))

    def to_sensor_file(self) -> SensorFile:
        """Return the content of `sensor.yaml` with the parameters of now."""
        changes = {
            "error": section_of(self.base.model, self.sensor.error),
            "effects": self.effects.to_mappings(),
            "noise": None if self.noise is None else self.noise.to_section(),
        }
        return self.sensor.model_copy(update=changes)

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded: the file without its parameters."""
        values = self.sensor.to_mapping()
        del values["tool_from_camera"]  # For those who render; nothing is computed with it.
        values["error"] = {key: values["error"][key] for key in ("reads", "terms")}
        values["effects"] = self.effects.description()
        if values["noise"] is not None:
            for name in ("floor_m", "shot_m", "read_m"):
                del values["noise"][name]
        return {"dtype": str(self.eye.ray_directions.dtype), **values}

    def forward(
        self,
        true_depth: Tensor,
        amplitude: Tensor | None = None,
        *,
        reflectivity: Tensor | None = None,
        generator: torch.Generator | None = None,
        noise: bool = True,
        frame_shift: Tensor | None = None,
        around: Around | None = None,
        **conditions: Condition,
    ) -> Measurement:
        """Return what the camera measures.

        Args:
            true_depth: Of the camera's kind, shape (..., H, W), metres; NaN, infinite or <= 0:
                nothing there.
            amplitude: Light that returns, the camera's units, the same shape; None: from the
                reflectivity.
            reflectivity: Of the surfaces, 0 to 1, the same shape; None: the usual one of the file.
            generator: Source of randomness; None: torch's own.
            noise: False: the expected measurement; nothing is drawn, and no pixel goes missing.
            frame_shift: What effects of whole frames add, shape (...), metres: a part of what
                `frame_shift` returned for a whole recording. None: computed for these frames.
            around: What else lights the scene by second bounces; None: what the frames show.
            **conditions: `timestamp_s`, `integration_time_us`, `room_temperature_c`,
                `body_temperature_c`, `ambient`: one number, or one for each frame (...). Frames
                stand in the order of their times. All but the time are held to the ranges that
                the sensor was measured in, an eighth of them wider.

        Raises:
            FrameError: The frames are of another size or dtype, or an amplitude is needed and
                nothing says it.
        """
        known = conditions_of(
            conditions, true_depth.shape[:-2], self.eye.ray_directions.device, self._ranges
        )
        parts = (self.base, self.effects, self.noise, self.dropouts)
        needed = any(part.needs_amplitude for part in parts if part is not None)
        needed = needed or self.bounces is not None
        frames = self.eye(true_depth, amplitude, reflectivity, known, needs_amplitude=needed)
        further = torch.zeros_like(frames.distance)
        if self.bounces is not None:
            lit = self._with_second_bounces(frames, self.bounces, around)
            # An error of the true distance was found beside what second bounces add.
            if not self.base.reads_measured:
                further = lit.distance - frames.distance
            frames = replace(lit, distance=lit.distance - further)
        radial = self._expected(frames, frame_shift) + further
        reported = frames.amplitude
        if noise and self.noise is not None:
            sigma = self.noise.sigma(frames.distance, frames.amplitude)
            radial = radial + sigma * self.noise.draw(radial, generator)
        # Errors far beyond what was measured can exceed a distance: such a pixel has none.
        valid = frames.seen & (radial > 0)
        saturated = torch.zeros_like(valid)
        if self.dropouts is not None:
            light = frames.amplitude.detach()
            if noise:
                drawn = torch.empty_like(light).uniform_(generator=generator)
                valid = valid & (drawn >= self.dropouts.probability(light))
            saturated = self.dropouts.saturated(light)
            # float16 ends at 65504, below the level of a camera that counts to 65535.
            level = self.dropouts.saturation_amplitude or torch.inf
            reported = reported.clamp(max=min(level, torch.finfo(reported.dtype).max))
        depth = torch.where(valid, radial / self.eye.radial_of_depth, torch.nan)
        valid = valid & ~saturated
        shape, dtype = true_depth.shape, true_depth.dtype
        lit = amplitude is not None or self.eye.light is not None
        return Measurement(
            depth.reshape(shape).to(dtype),
            reported.reshape(shape).to(dtype) if lit else None,
            valid.reshape(shape),
        )

    def covers(self, true_depth: Tensor, amplitude: Tensor | None = None) -> Tensor:
        """Return where distance and amplitude are within the ranges that were measured, bool.

        Beyond them the error at the range's edge is used. Without an amplitude only the distance
        counts.
        """
        radial = true_depth * self.eye.radial_of_depth.to(true_depth)
        return self.base.limits.holds(radial, amplitude)

    def frame_shift(self, count: int, **conditions: Condition) -> Tensor:
        """Return what effects of whole frames (warm-up, temperature) add, shape (B,), metres.

        For a recording in parts: frames of later parts depend on those before.
        """
        known = conditions_of(conditions, (count,), self.eye.ray_directions.device, self._ranges)
        return self.effects.frame_shift(known, count, self.eye.ray_directions)

    def usual_light(self, frames: SceneFrames) -> Tensor:
        """Return amplitudes (B, H, W) at the mean integration time, that of the gain."""
        exposure, known = frames.conditions.get("integration_time"), self._ranges
        if exposure is None or "integration_time" not in known:
            return frames.amplitude
        share = known["integration_time"][2] / exposure
        return frames.amplitude * share[:, None, None].to(frames.amplitude)

    def _with_second_bounces(
        self, frames: SceneFrames, bounces: SecondBounces, around: Around | None
    ) -> SceneFrames:
        """Return frames as the light of all bounces shows them; the surfaces stay."""
        found, light = [], self.usual_light(frames)
        for number, own in enumerate(zip(frames.distance, light, frames.seen, strict=True)):
            images = torch.where(own[2], own[0], torch.nan), own[1]
            if around is None:
                found.append(bounces.added(*images))
            else:
                pose = around.world_from_camera[number]
                found.append(
                    added_around(bounces, *images, around.surroundings, pose, self._half_angle)
                )
        distance, amplitude = (torch.stack(images) for images in zip(*found, strict=True))
        brighter = torch.where(light > 0, amplitude / light, 1.0)
        return replace(
            frames,
            distance=torch.where(frames.seen, distance, frames.distance),
            amplitude=torch.where(frames.seen, frames.amplitude * brighter, frames.amplitude),
        )

    def _expected(self, frames: SceneFrames, of_frame: Tensor | None) -> Tensor:
        """Return the expected distance along the ray, shape (B, H, W), metres."""
        known = frames.conditions
        self._say(self.effects.usable(known)[1])
        one_by_one = self.sensor.effects_see == "delayed_distance"
        lens = self.effects.shift(Group.GEOMETRY, frames)
        at = replace(frames, distance=frames.distance + lens) if one_by_one else frames
        conditions = with_means(known, self.base.mean_conditions)
        error = self.base(at.distance, frames.amplitude, conditions)
        if of_frame is None:
            of_frame = self.effects.frame_shift(known, len(frames.distance), frames.rays)
        error = error + of_frame.to(error.dtype).reshape(-1, 1, 1)
        error = error + self.effects.shift(Group.DELAY, at)
        at = replace(at, distance=at.distance + error) if one_by_one else frames
        return frames.distance + lens + error + self.effects.shift(Group.SIGNAL, at)

    def _say(self, sentences: Sequence[str]) -> None:
        """Warn of effects that are left out, once of each."""
        new = [sentence for sentence in sentences if sentence not in self._said]
        self._said.update(new)
        if new:
            warnings.warn("Left out: " + " ".join(new), SensorWarning, stacklevel=4)
