"""When a remainder is called unknown: significance, size, and how far poses may scatter."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diagnosed_recordings import recorded, simulator, true_inputs

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.gap import allowed_scatter, judge_remainder, measure_gap, resampled
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.findings.structure import coherence
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.linear_system import pose_columns
from tofcorr.diagnosis.sums.observations import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance

POOR_ROBOT = {"robot": {"repeatability_mm": 2.0, "repeatability_mrad": 2.0}}


def test_poses_of_a_poor_robot_are_unknown_only_if_a_better_one_is_stated(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "poor", 50, [], POOR_ROBOT)
    study = prepare(recording, DiagnosisOptions(catalogue=("wiggling", "lens"))).study
    named = name_effects(study)
    resamples = resampled(study.sums.num_units, 30, torch.Generator().manual_seed(1))
    gap = measure_gap(study, named, resamples)
    left = judge_remainder(study, named, gap)
    assert named.names == ()
    assert not left.unknown
    assert 1e-3 < left.scatter < 4e-3
    stated = study.options.model_copy(update={"pose_repeatability_mm": 0.3})
    assert judge_remainder(replace(study, options=stated), named, gap).unknown


def test_poses_may_scatter_by_three_millimetres_and_milliradians(nothing_study: Study) -> None:
    """The turns' share is compared with distances seen after a small turn about each axis."""
    observations, pose = nothing_study.observations, nothing_study.fit.tool_from_camera
    share, squares = nothing_study.fit.share, 0.0
    for axis in range(3, 6):
        turn = se3.exp(1e-6 * torch.eye(6, dtype=torch.float64)[axis])
        moved = predicted_distance(observations, pose @ turn)
        slope = (moved - predicted_distance(observations, pose)) / 1e-6
        squares += float((share * slope**2).sum() / share.sum())
    expected = 0.003**2 * (1 + squares)
    after = replace(coherence(nothing_study, nothing_study.fit.residual), between=1.0)
    assert allowed_scatter(nothing_study, after) == pytest.approx(expected, rel=1e-3)


def test_pose_columns_are_what_small_motions_of_the_target_do(nothing_missing: Recording) -> None:
    """Turned by a milliradian about any point and shifted, a plane's distance is in their span."""
    inputs = true_inputs(nothing_missing, simulator(31))
    here = inputs.frame == 3
    facts = inputs.facts
    moved = se3.exp(torch.tensor([1e-4, -2e-4, 3e-4, 1e-4, -2e-4, 1e-4], dtype=torch.float64))
    pose = facts.world_from_tool[3] @ inputs.tool_from_camera
    rays = ray_directions(inputs.camera)
    distances = [
        ray_plane_distance(rays, *plane_in_frame(facts.normal_world[3], facts.offset[3], place))
        for place in (pose, moved @ pose)
    ]
    change = (distances[1] - distances[0]).flatten()[inputs.pixel[here]]
    columns = pose_columns(inputs)[here]
    fitted = columns @ torch.linalg.lstsq(columns, change[:, None]).solution
    assert float((fitted[:, 0] - change).abs().max()) < 2e-3 * float(change.abs().max())
