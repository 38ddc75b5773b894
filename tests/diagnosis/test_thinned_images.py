"""Of large images some pixels are chosen; what belongs to single pixels is found all the same."""

from pathlib import Path

import torch
from diagnosed_recordings import recorded
from optional import present

from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.sums.observations import observe
from tofcorr.simulation.effects.patterns import drawn_values
from tofcorr.simulation.effects.registry import CATALOGUE

_SPREAD, _SEED = 0.004, 6
_PATTERN = {"name": "fixed_pattern", "height": 48, "width": 64, "rms_m": _SPREAD, "seed": _SEED}
_LARGER = {
    "camera": {
        "width": 64,
        "height": 48,
        "K": [[90.0, 0.0, 31.5], [0.0, 90.0, 23.5], [0.0, 0.0, 1.0]],
    },
    "shots": [{"target": "white", "poses": 24}],
}


def test_chosen_pixels_are_the_same_in_all_frames_and_spread_evenly(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "plain", 3, changes=_LARGER)
    usable = torch.bincount(observe(recording, 24 * 64 * 48).frame)
    observations = observe(recording, 24 * 300)
    whole = torch.nonzero(usable == 64 * 48)[:, 0]
    assert len(whole) > 10
    by_frame = observations.pixel[torch.isin(observations.frame, whole)].reshape(-1, 300)
    assert bool((by_frame == by_frame[0]).all())
    rows, columns = by_frame[0] // 64, by_frame[0] % 64
    counts = torch.bincount((rows // 16) * 4 + columns // 16, minlength=12)
    # 25 in each of 12 squares; drawn at random, their squared deviations would sum up to 275.
    assert int((counts - 25).square().sum()) < 100
    # Where the wall fills a part of the image, as many pixels of that part are chosen.
    assert torch.bincount(observations.frame).tolist() == usable.clamp(max=300).tolist()


def test_a_fixed_pattern_is_named_and_handed_on_in_all_pixels(tmp_path: Path) -> None:
    """A tenth of the pixels is diagnosed; the simulator has the pattern of each."""
    recording = recorded(tmp_path / "pattern", 4, [_PATTERN], _LARGER)
    quick = {"most_pixels": 24 * 300, "bootstraps": 19, "simulate_anew": False}
    found = diagnose(recording, config=quick)
    assert found.effects == ("fixed_pattern",)
    (entry,) = present(found.simulator).effects
    values = {key: value for key, value in entry.items() if key != "name"}
    pattern = CATALOGUE["fixed_pattern"].from_mapping(values, "the file").coefficients
    truth = drawn_values(64 * 48, _SPREAD, _SEED)
    noise = float(found.evidence.study.fit.sigma.median())
    # Means over 16 to 24 poses, and the smooth part that calibration takes.
    error = float((pattern - truth).std())
    assert noise / 24**0.5 < error < 1.2 * noise / 16**0.5
