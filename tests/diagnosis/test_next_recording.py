"""What to record next: frames that can be recorded, of conditions that the recording states."""

from dataclasses import replace

import torch
from optional import present

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.next.advice import make_candidates, next_recording
from tofcorr.diagnosis.sums.study import Study


def without_conditions(study: Study, timestamp: torch.Tensor) -> Study:
    """Return a study whose frames state time stamps and nothing else."""
    bare = dict.fromkeys(("integration_time", "room_temperature", "ambient"))
    facts = replace(study.observations.facts, timestamp=timestamp, **bare)
    return replace(study, observations=replace(study.observations, facts=facts))


def test_time_is_varied_only_where_the_stamps_are_of_a_clock(nothing_study: Study) -> None:
    number = torch.arange(nothing_study.observations.num_frames).double()
    for stamps, is_clock in ((number, False), (10.0 + 0.7 * number, True)):
        study = without_conditions(nothing_study, stamps)
        candidates = present(make_candidates(study, ["distance"]))
        assert ("after all others" in candidates[0]) == is_clock


def test_without_anything_to_vary_the_advice_is_how_to_observe_the_effect(
    nothing_study: Study, nothing_named: NamedEffects
) -> None:
    number = torch.arange(nothing_study.observations.num_frames).double()
    study = without_conditions(nothing_study, number)
    recording = study.observations.recording
    poses = torch.eye(4).double().expand(len(number), 4, 4).numpy()
    still = replace(recording, frames=replace(recording.frames, world_from_tool=poses))
    study = replace(study, observations=replace(study.observations, recording=still))
    assert make_candidates(study, ["distance"]) is None
    advice = next_recording(study, nothing_named)
    assert any(one.startswith("To observe ") for one in advice)
    assert not any("more frames" in one for one in advice)
