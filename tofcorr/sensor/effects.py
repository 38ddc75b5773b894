"""Effects of the catalogue, applied to depth images of any scene."""

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import torch
from torch import Tensor, nn

from tofcorr.conditions import condition
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.sensor.scene import SceneFrames
from tofcorr.simulation.effects.base import AMPLITUDE, FREQUENCY, CatalogueEffect, EffectInputs
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.hooks import Effect


class Group(Enum):
    """Stages of the simulator in groups, in their order; and what delays whole frames."""

    FRAME = ()
    GEOMETRY = ("pose", "geometry")
    DELAY = ("delay",)
    SIGNAL = ("signal", "taps", "readout")


class ImageEffect(nn.Module):
    """One effect; its coefficients are a parameter.

    Args:
        effect: The effect with its coefficients.

    Attributes:
        group: The last group of stages at which it acts; that of whole frames by itself.
    """

    def __init__(self, effect: CatalogueEffect) -> None:
        super().__init__()
        self.effect = effect
        stages = [(group, f"on_{stage}") for group in Group for stage in group.value]
        acts = [g for g, hook in stages if getattr(type(effect), hook) is not getattr(Effect, hook)]
        self.group = Group.FRAME if effect.of_frame else [Group.DELAY, *acts][-1]
        self.coefficients = nn.Parameter(effect.coefficients.clone())

    def shift(self, inputs: EffectInputs) -> Tensor:
        """Return the change of the measured distance in the chosen pixels, (M,), metres."""
        return self.effect.shift(inputs, self.coefficients.to(inputs.radial_distance.dtype))

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of a simulator's YAML."""
        return self.effect.with_coefficients(self.coefficients.detach().cpu()).to_mapping()


class ImageEffects(nn.Module):
    """The effects of a sensor that depth images can show.

    There are three groups: geometry (the lens), delays, and what mixes signals. The shifts of a
    group add up.

    Args:
        camera: The camera intrinsics.
        entries: As in a simulator's YAML.
        modulation_frequency: Hz; None if unknown.

    Attributes:
        left_out: Effects that no depth image can show, and why, a sentence each.

    Raises:
        ConfigError: An effect is unknown, or a parameter is wrong.
    """

    def __init__(
        self,
        camera: CameraIntrinsics,
        entries: Sequence[Mapping[str, Any]],
        modulation_frequency: float | None,
    ) -> None:
        super().__init__()
        self._camera, self._frequency = camera, modulation_frequency
        self.left_out: list[str] = []
        self._kept_as_given: list[Mapping[str, Any]] = []
        self.effects = nn.ModuleList()
        for entry, effect in zip(entries, build_effects(entries), strict=True):
            reasons = [need.beyond_image for need in effect.needs if need.beyond_image]
            if modulation_frequency is None and FREQUENCY in effect.needs:
                reasons.append("the sensor states no modulation_frequency_hz")
            if reasons:
                self.left_out.append(f"{effect.name}: {reasons[0]}.")
                self._kept_as_given.append(entry)
            else:
                self.effects.append(ImageEffect(effect))

    @property
    def needs_amplitude(self) -> bool:
        """Whether an effect reads the amplitude."""
        return any(AMPLITUDE in each.effect.needs for each in self._all())

    @property
    def reads_light(self) -> bool:
        """Whether an effect reads the light of clipped pixels."""
        return any(each.effect.reads_light for each in self._all())

    def usable(self, known: Mapping[str, Tensor]) -> tuple[list[ImageEffect], list[str]]:
        """Return the effects whose conditions are known, and a sentence about each other one."""
        usable, missing = [], []
        for each in self._all():
            needed = [need.condition for need in each.effect.needs if need.condition]
            columns = [condition(name).column for name in needed if name not in known]
            if columns:
                missing.append(f"{each.effect.name}: {', '.join(columns)} was not given.")
            else:
                usable.append(each)
        return usable, missing

    def frame_shift(self, known: Mapping[str, Tensor], count: int, like: Tensor) -> Tensor:
        """Return the shift that effects of whole frames cause, shape (B,), metres, float64.

        The order of the frames is that of the recording: a warm-up depends on those before.

        Args:
            known: Conditions by name, each (B,).
            count: Number of frames, B.
            like: Any tensor of the device.
        """
        one = like.new_ones(count, 1, 1, dtype=torch.float64)
        frames = SceneFrames(
            rays=one.new_tensor([[[0.0, 0.0, 1.0]]]),
            distance=one,
            amplitude=torch.zeros_like(one),
            seen=one > 0,
            conditions=known,
            surface=lambda: (one, one.expand(count, 1, 3)),
        )
        return self.shift(Group.FRAME, frames).reshape(-1).expand(count)

    def shift(self, group: Group, frames: SceneFrames) -> Tensor:
        """Return the change of the measured distance by one group, metres.

        Shape (B, H, W); a single zero, shape (1, 1, 1), if the group has no effect.

        Args:
            group: Which effects.
            frames: The frames, at the distance that the effects see.
        """
        usable, distance = self.usable(frames.conditions)[0], frames.distance
        chosen = [each for each in usable if each.group == group]
        if not chosen:
            return distance.new_zeros(1, 1, 1)
        with distance.device:
            inputs = frames.inputs(self._camera, self._frequency)
            first, *others = (each.shift(inputs) for each in chosen)
        return sum(others, first).reshape(distance.shape).to(distance.dtype)

    def to_mappings(self) -> tuple[Mapping[str, Any], ...]:
        """Return the entries of a simulator's YAML, with the coefficients of now."""
        return (*(each.to_mapping() for each in self._all()), *self._kept_as_given)

    def description(self) -> list[Any]:
        """Return names and shapes of the effects, and the entries that no image can show."""
        shapes = [[each.effect.name, each.effect.shape.to_mapping()] for each in self._all()]
        return [*shapes, *self._kept_as_given]

    def _all(self) -> list[ImageEffect]:
        return [each for each in self.effects if isinstance(each, ImageEffect)]
