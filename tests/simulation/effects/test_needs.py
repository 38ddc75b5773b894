"""A column that is missing or not complete is named, and never taken for zero."""

from dataclasses import replace

import torch
from simulation.effects.scenes import Scene

from tofcorr.simulation.effects import CATALOGUE


def test_a_missing_or_incomplete_column_is_named_and_not_taken_for_zero(at_rest: Scene) -> None:
    facts = replace(at_rest.inputs.facts, integration_time=None, room_temperature=None)
    blind = replace(at_rest.inputs, facts=facts, amplitude=None, modulation_frequency=None)
    assert CATALOGUE["integration_time"].missing(blind) == ["integration_time_us"]
    assert CATALOGUE["room_temperature"].missing(blind) == ["room_temperature_c"]
    assert CATALOGUE["stray_light"].missing(blind) == [
        "amplitude.npy",
        "modulation_frequency_hz in recording.yaml",
    ]
    assert CATALOGUE["motion"].missing(blind)[0] == "velocity of the tool"
    assert CATALOGUE["incidence_angle"].missing(blind) == []
    times = torch.full((8,), 5e-4, dtype=torch.float64)
    times[3] = torch.nan
    facts = replace(at_rest.inputs.facts, integration_time=times)
    inputs = replace(at_rest.inputs, facts=facts)
    assert CATALOGUE["integration_time"].missing(inputs) == ["integration_time_us"]


def test_time_stamps_that_count_the_frames_are_no_clock(at_rest: Scene) -> None:
    """The views of a Kinect v2 have frame numbers: nothing drifts with them."""
    facts = at_rest.inputs.facts
    counts = torch.arange(len(facts.timestamp), dtype=torch.float64)
    for times, missing in ((facts.timestamp, []), (counts, ["timestamp_s of a clock"])):
        inputs = replace(at_rest.inputs, facts=replace(facts, timestamp=times))
        assert CATALOGUE["warm_up"].missing(inputs) == missing
