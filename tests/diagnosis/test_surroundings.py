"""Objects beside the target send light into the same lens."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from diagnosed_recordings import altered, recorded, simulator
from optional import present

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.rerun.simulator import twin_distance
from tofcorr.diagnosis.sums.base import BaseFit, filtered_inputs
from tofcorr.diagnosis.sums.observations import effect_inputs, observe, predicted_images
from tofcorr.simulation.effects.stray_light import StrayLightEffect
from tofcorr.simulation.simulator import default_hand_eye, twin_frames

NEAR, WIDTH = 0.5, 6  # metres; columns of the image
STRAY_SHARES = {"share_0.05": 0.02, "share_0.12": 0.05, "share_0.3": 0.02, "ghost_0.72": 0.01}
STRAY = {"name": "stray_light", **STRAY_SHARES}


def masked(recording: Recording) -> Recording:
    """Leave the left edge of every image to something beside the target."""
    inside = np.broadcast_to(np.arange(recording.camera.width) >= WIDTH, recording.depth.shape)
    np.save(recording.path / "mask.npy", inside.astype(np.uint8))
    return Recording.open(recording.path)


@pytest.fixture(scope="module")
def cluttered(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The target's left edge hidden by something near, and nothing at all above that."""
    recording = masked(recorded(tmp_path_factory.mktemp("cluttered") / "r", 44, noise=False))
    beside = np.full((recording.camera.height, WIDTH), NEAR)
    beside[:5] = np.nan
    return altered(
        recording, lambda z: np.concatenate([0 * z[..., :WIDTH] + beside, z[..., WIDTH:]], axis=2)
    )


def test_the_twin_keeps_what_stands_beside_the_target(cluttered: Recording) -> None:
    options = simulator(44, [])
    state = next(twin_frames(options, cluttered, reflectivity="from_recording"))
    plain = next(twin_frames(options, cluttered))
    beside = state.radial_distance[:, :WIDTH]
    assert bool(beside[:5].isnan().all())
    assert bool(state.measured_distance[:5, :WIDTH].isnan().all())
    torch.testing.assert_close(beside[5:], torch.full_like(beside[5:], NEAR))
    torch.testing.assert_close(state.radial_distance[:, WIDTH:], plain.radial_distance[:, WIDTH:])


def test_pixels_of_the_plane_beside_the_mask_have_no_noise(tmp_path: Path) -> None:
    """Where a camera filters, measured neighbours would explain the noise of pixels at the edge."""
    four = {"shots": [{"target": "white", "poses": 4}]}
    recording = masked(recorded(tmp_path / "recording", 44, [], four))
    beside = np.arange(recording.camera.width) < WIDTH // 2
    recording = altered(recording, lambda z: np.where(beside, NEAR, z))
    observations = observe(recording, 100_000)
    pose = default_hand_eye(simulator(44), observations.recording)
    inputs = effect_inputs(observations, pose)
    fit = SimpleNamespace(
        shared=SimpleNamespace(share={"rows": 0.3}),
        tool_from_camera=pose,
        sigma=torch.full_like(observations.measured, 0.002),
    )
    seen = present(filtered_inputs(inputs, observations, cast("BaseFit", fit)).distance_images)
    plane = predicted_images(observations, pose, slice(None)).float()
    whole = (observations.distance_images > 0).all((1, 2))  # The others are saturated in part.
    assert bool(whole.any())
    torch.testing.assert_close(seen[whole, :, WIDTH // 2 :], plane[whole, :, WIDTH // 2 :])
    assert not bool((seen == plane)[whole, :, : WIDTH // 2].any())


def test_stray_light_of_surroundings_is_the_same_in_twin_and_fit(cluttered: Recording) -> None:
    observations = observe(cluttered, 100_000)
    without, with_stray = (simulator(44, e) for e in ([], [STRAY]))
    pose = default_hand_eye(without, cluttered)
    shift = twin_distance(observations, with_stray, pose) - twin_distance(
        observations, without, pose
    )
    inputs = effect_inputs(observations, pose)
    effect = StrayLightEffect.for_recording(inputs)
    effect = StrayLightEffect.from_mapping({**effect.shape.to_mapping(), **STRAY_SHARES}, "")
    expected = effect.shift(inputs, effect.coefficients)
    size = float(expected.square().mean().sqrt())
    assert size > 2e-3
    # The fit predicts distances without the sensor's own delays; the twin scatters delayed light.
    assert float((shift - expected).square().mean().sqrt()) < 0.1 * size
