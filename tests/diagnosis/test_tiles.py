"""Image tiles as units: for effects that only a few images show."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import diagnosed_recordings
import pytest
import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.effect_comparison import compare_effects
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.linear_system import cut_into_tiles, tile_sums
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.saturation import light_of

DIM = {"sensor": {"light": {"electrons_at_1m": 300_000.0}}}
CLIP: dict[str, Any] = {
    "name": "saturation",
    "full_counts": 40_000.0,
    "knees": [1.0],
    "softness": 0.02,
    "knee_1": 1.0,
}


@pytest.fixture(scope="module")
def clipped(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder: Path = tmp_path_factory.mktemp("clipped") / "recording"
    return diagnosed_recordings.recorded(folder, 50, [CLIP], DIM)


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder: Path = tmp_path_factory.mktemp("straight") / "recording"
    return diagnosed_recordings.recorded(folder, 50, [], DIM)


def test_sums_over_tiles_add_up_to_sums_over_poses(nothing_study: Study) -> None:
    tiles, sums = nothing_study.tiles, nothing_study.sums
    assert tiles is not None
    names = ["wiggling", "saturation"]
    own = tile_sums(nothing_study.system, names, tiles, nothing_study.fit)
    gram, score, _ = sums.ols.of(names)
    summed = torch.zeros_like(gram).index_add(0, tiles.pose, own.ols.gram)
    torch.testing.assert_close(summed, gram, rtol=1e-9, atol=1e-9)
    summed = torch.zeros_like(score).index_add(0, tiles.pose, own.ols.score)
    torch.testing.assert_close(summed, score, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(tiles.per_pose(own.count, sums.num_units), sums.count)
    square = tiles.per_pose(own.ols.square, sums.num_units)
    torch.testing.assert_close(square, sums.ols.square)


def test_an_offset_and_tilts_of_a_pose_do_not_show_in_its_tiles(nothing_study: Study) -> None:
    """Tiles flip on their own: what they had in common would look like an effect."""
    study, tiles = nothing_study, nothing_study.tiles
    assert tiles is not None
    moved = study.system.pose @ torch.tensor([1e-3, 5e-4, -5e-4], dtype=torch.float64)
    shifted = replace(study.system, residual=study.system.residual + moved)
    names = ["saturation"]
    before, after = (
        tile_sums(system, names, tiles, study.fit).gls.score[len(tiles.whole) :]
        for system in (study.system, shifted)
    )
    own = slice(study.sums.layout.base, None)
    change = (after - before)[:, own].norm(dim=0) / before[:, own].norm(dim=0)
    assert float(change.max()) < 1e-6


def test_the_units_are_whole_poses_and_tiles_of_others(nothing_study: Study) -> None:
    tiles = nothing_study.tiles
    assert tiles is not None
    poses_cut = nothing_study.unit_of_pixel[tiles.pixels].unique()
    assert not torch.isin(poses_cut, tiles.whole).any()
    assert len(poses_cut) + len(tiles.whole) == nothing_study.system.sums.num_units
    assert sum(tiles.counts) == len(tiles.pixels) == len(tiles.pixels.unique())


def _three_images_clipped(folder: Path, seed: int) -> Recording:
    straight = diagnosed_recordings.recorded(folder / f"straight_{seed}", seed, [], DIM)
    images = observe(straight, 1000).amplitude_images
    assert images is not None
    fourth = float(images.flatten(1).amax(1).sort(descending=True).values[3])
    # The brightest tap of a pixel without ambient light: A (1 + 1 / contrast).
    clip = CLIP | {"full_counts": 3.0 * fourth}
    return diagnosed_recordings.recorded(folder / f"clipped_{seed}", seed, [clip], DIM)


def _names_saturation(recording: Recording) -> bool:
    study = prepare(recording, DiagnosisOptions(), None).study
    return any("saturation" in members for members in name_effects(study).cause_sets)


def test_clipping_that_three_images_of_fifty_hold_is_named(tmp_path: Path) -> None:
    assert _names_saturation(_three_images_clipped(tmp_path, 50))


@pytest.mark.slow
def test_clipping_that_three_images_of_fifty_hold_is_mostly_named(tmp_path: Path) -> None:
    seeds = range(50, 56)
    assert sum(_names_saturation(_three_images_clipped(tmp_path, seed)) for seed in seeds) >= 5


def test_nothing_is_called_saturation_where_nothing_clips(straight: Recording) -> None:
    comparison = compare_effects(prepare(straight, DiagnosisOptions(), None).study, ())
    assert comparison.family_p_value("saturation") > 0.05


def test_the_light_of_clipped_pixels_is_told_from_dim_ones(
    clipped: Recording, straight: Recording
) -> None:
    light = observe(straight, 10_000_000).amplitude_images
    assert light is not None
    study = prepare(clipped, DiagnosisOptions(), None).study
    inputs = study.inputs
    true = light.flatten(1)[inputs.frame, inputs.pixel].double()
    lost = inputs.known_amplitude < 0.9 * true
    assert int(lost.sum()) > 100
    recorded_error = (inputs.known_amplitude / true).log()[lost].square().mean().sqrt()
    error = (light_of(inputs) / true).log()[lost].square().mean().sqrt()
    assert error < 0.5 * recorded_error
    assert ((light_of(inputs) / true - 1).abs() < 0.1)[~lost].double().mean() > 0.98


def test_tiles_of_filtered_noise_are_nearly_independent() -> None:
    """Their squares add up to most of the variance of the whole; those of small tiles do not."""
    generator = torch.Generator().manual_seed(5)
    noise = torch.randn(1, 1000, 36, 48, generator=generator, dtype=torch.float64)
    taps = torch.exp(-0.5 * (torch.arange(-3.0, 4.0).double() / 1.2) ** 2)
    for kernel in (taps[:, None], taps[None, :]):
        own = kernel.expand(1000, 1, *kernel.shape)
        noise = torch.nn.functional.conv2d(noise, own, padding="same", groups=1000)
    pixel = torch.arange(36 * 48)
    camera = SimpleNamespace(width=48, height=36)
    observations = SimpleNamespace(
        recording=SimpleNamespace(camera=camera),
        unit=torch.zeros(1, dtype=torch.int64),
        frame=torch.zeros_like(pixel),
        pixel=pixel,
    )
    one = (
        cast("Observations", observations),
        torch.ones(1).double(),
        DiagnosisOptions().tests,
        generator,
    )
    shares = []
    for filtered in (False, True):
        tiles = cut_into_tiles(*one, filtered)
        of_tiles = noise.flatten(2)[0][:, tiles.pixels].split(tiles.counts, dim=1)
        sums = torch.stack([values.sum(1) for values in of_tiles])
        shares.append(float(sums.square().sum() / sums.sum(0).square().sum()))
    small, large = shares
    assert small < 0.65
    assert large > 0.7
