"""Corrections trained on simulated and on real images, tested on held-out real poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from diagnosed_recordings import simulator
from diagnosis.resamples import resamples_of
from optional import present
from torch import Generator

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.given import open_simulator
from tofcorr.diagnosis.rerun.checks import measure_transfer, noisy_frames
from tofcorr.diagnosis.rerun.simulator import Evidence, fitted_to, mount_at
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.observables.compare import Observables


def test_with_nothing_missing_every_correction_leaves_less_than_half_a_millimetre(
    nothing_study: Study, nothing_named: NamedEffects
) -> None:
    generator = Generator().manual_seed(1)
    resamples = resamples_of(nothing_study, 2)
    found = Evidence(study=nothing_study, named=nothing_named)
    transfer = present(measure_transfer(found, generator, resamples))
    # Without an effect both simulators are one, and so are the corrections: also their noise.
    assert nothing_named.names == ()
    assert transfer.gain.interval == (0.0, 0.0)
    assert transfer.trained_on_sim_with_effects == transfer.trained_on_sim < 5e-4
    assert transfer.trained_on_real < 5e-4


def test_poses_that_are_held_out_have_no_influence_on_what_is_fitted(nothing_study: Study) -> None:
    held_out = nothing_study.folds.argmax(0) < 3
    sums = nothing_study.sums
    wild = replace(sums, plain=sums.plain + 1e3 * held_out[:, None, None])
    fitted = [
        fitted_to(study, ~held_out, ()).sums.ols.solve(())
        for study in (nothing_study, replace(nothing_study, sums=wild))
    ]
    assert torch.equal(*fitted)
    assert not torch.allclose(fitted[0], sums.ols.solve(()))


def test_the_simulator_that_took_the_recording_has_its_noise(nothing_missing: Recording) -> None:
    frames = noisy_frames(nothing_missing, simulator(31), 7)
    assert frames.num_frames == nothing_missing.num_frames
    poses = torch.from_numpy(frames.frames.world_from_tool)
    torch.testing.assert_close(poses, torch.from_numpy(nothing_missing.frames.world_from_tool))
    found = Observables(nothing_missing, frames, seed=7)
    noise = present(found.noise)
    assert noise["same_poses"]
    assert noise["ratio"] == pytest.approx(1.0, abs=0.05)
    assert found.explained_by == ()


def test_frames_of_any_simulator_are_compared_as_rendered(nothing_missing: Recording) -> None:
    frames = noisy_frames(nothing_missing, simulator(31), 3)
    depth = np.asarray(frames.depth)
    found = []
    for sim in (frames, lambda _: depth):
        opened = open_simulator(sim, nothing_missing)
        assert isinstance(opened, Recording)
        found.append(Observables(nothing_missing, opened, seed=7))
    assert found[1].amplitude is None
    compared, without_amplitude = (present(one.noise) for one in found)
    assert compared["same_poses"]
    assert without_amplitude["ratio"] == pytest.approx(compared["ratio"], abs=0.15)


def test_hand_eye_options_hold_any_transform(generator: Generator) -> None:
    transform = se3.exp(torch.randn(6, generator=generator, dtype=torch.float64))
    found = mount_at(transform).tool_from_camera()
    torch.testing.assert_close(found, transform, rtol=0, atol=1e-12)
