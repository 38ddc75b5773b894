"""What a found sensor is expected to measure at frames of a recording, without noise."""

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.geometry.rays import ray_directions
from tofcorr.sensor.degrade import conditions_of_frames
from tofcorr.sensor.model import SensorModel
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.saturation import light_of

# Pixels measured at once. Chosen to bound memory to some 100 MB.
_CHUNK_PIXELS = 500_000


def expected_images(
    model: SensorModel,
    recording: Recording,
    frames: Tensor,
    distance: Tensor,
    amplitude: Tensor | None,
) -> Tensor:
    """Return the expected radial distances of F frames, shape (F, H, W), metres.

    Args:
        model: The sensor.
        recording: Conditions of all frames: effects of whole frames depend on those before.
        frames: Numbers of the F frames, int64.
        distance: True distances along the rays, shape (F, H, W), metres.
        amplitude: Light that returns, shape (F, H, W), counts; None: unknown.
    """
    known = conditions_of_frames(recording)
    shift = model.frame_shift(recording.num_frames, **known)
    slant = ray_directions(recording.camera)[..., 2]
    scale = slant if model.sensor.depth_kind == "z" else torch.ones_like(slant)
    measured = []
    with torch.inference_mode():
        for part in torch.arange(len(frames)).split(max(1, _CHUNK_PIXELS // scale.numel())):
            chosen = frames[part]
            found = model(
                distance[part].double() * scale,
                None if amplitude is None else amplitude[part].double(),
                noise=False,
                frame_shift=shift[chosen],
                **{name: torch.as_tensor(value)[chosen] for name, value in known.items()},
            )
            measured.append(found.depth / scale)
    return torch.cat(measured)


def light_images(
    model: SensorModel, observations: Observations, inputs: EffectInputs
) -> Tensor | None:
    """Return the light that reached the camera, shape (F, H, W), counts; None: not recorded.

    It is the recorded amplitude. Where a sensor clips bright pixels, that of the chosen pixels is
    what it would have been without clipping, as in the fit.
    """
    images = observations.amplitude_images
    if images is None or not model.effects.reads_light:
        return images
    lit = images.double().flatten(1)
    lit[observations.frame, observations.pixel] = light_of(inputs)
    return lit.reshape(images.shape)
