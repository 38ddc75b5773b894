"""Every kind of error term as part of the base model: fitted, or refused with the true reason."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
from diagnosed_recordings import recorded
from diagnosis.resamples import unnamed

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import diagnose, prepare
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.rerun.simulator import Evidence
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.registry import TERMS
from tofcorr.errors import CalibrationDataError
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

DEMO = Path(__file__).parents[2] / "configs" / "simulate" / "demo.yaml"
KINDS = sorted(TERMS)
OF_EACH_SORT = ("amplitude_polynomial", "fixed_pattern", "periodic", "warm_up")
NEEDS = {
    "periodic": "modulation_frequency_hz",
    "integration_time": "integration_time_us",
    "room_temperature": "room_temperature_c",
}
QUICK = {"bootstraps": 19, "most_pixels": 8000, "page": False, "simulate_anew": False}
PATTERN = {"name": "fixed_pattern", "rms_m": 0.006, "height": 24, "width": 32}
PATTERNS = ["fixed_pattern", "row_column_pattern", "lens", "wiggling"]


def _base(*kinds: str) -> dict[str, Any]:
    return QUICK | {"base": {"terms": [{"kind": kind} for kind in kinds]}}


def _study(recording: Recording, *kinds: str, **changes: Any) -> Study:
    options = DiagnosisOptions.from_mapping(_base(*kinds) | changes, "test")
    return prepare(recording, options).study


def _fitted(recording: Recording, *kinds: str) -> Study:
    """Return the study of a base model alone."""
    return _study(recording, *kinds, catalogue=[])


@pytest.fixture(scope="module")
def beside_pixels(nothing_missing: Recording) -> Callable[[str], Study]:
    """The study of a base model of the pixel and one more kind of term, made once for each."""
    return cache(lambda kind: _fitted(nothing_missing, *dict.fromkeys(("pixel_polynomial", kind))))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The demo recording with 12 poses."""
    values = resolve_options(SimulatorOptions, DEMO).to_mapping()
    shots = [{"target": "white", "poses": 5}, {"target": "checkerboard", "poses": 7}]
    path = tmp_path_factory.mktemp("demo") / "demo"
    simulate(SimulatorOptions.from_mapping(values | {"shots": shots}, "test"), path)
    return Recording.open(path)


@pytest.mark.parametrize(
    "kind",
    [k if k in OF_EACH_SORT else pytest.param(k, marks=pytest.mark.slow) for k in KINDS],
)
def test_every_kind_of_term_can_be_the_base_of_a_diagnosis(kind: str, demo: Recording) -> None:
    found = diagnose(demo, config=_base(kind) | {"catalogue": ["wiggling", "lens"]})
    assert np.isfinite([found.gap.before, found.gap.after, found.gap.floor]).all()
    assert set(found.evidence.named.ranking) == {"wiggling", "lens"}
    expected = ("lacks these terms", "as outliers")  # A base of one term misfits some pixels.
    assert all(any(words in warning for words in expected) for warning in found.warnings)


@pytest.mark.parametrize("kind", NEEDS)
def test_a_term_without_its_input_is_refused_by_what_is_missing(kind: str, tmp_path: Path) -> None:
    hidden = {"conditions": {"recorded": ["pose_id"]}}
    recording = recorded(tmp_path / "hidden", 46, [], hidden)
    unknown = replace(recording, modulation_frequency=None)
    with pytest.raises(CalibrationDataError, match=f"{NEEDS[kind]}.*{kind}"):
        _fitted(unknown, kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_term_never_makes_the_fit_worse(
    kind: str, beside_pixels: Callable[[str], Study], nothing_missing: Recording
) -> None:
    if kind == "pixel_polynomial":
        without = _fitted(nothing_missing)
    else:
        without = beside_pixels("pixel_polynomial")
    with_term = beside_pixels(kind)
    weight = without.fit.trust / without.fit.sigma**2
    squares = [float((weight * study.residual_of(()) ** 2).sum()) for study in (with_term, without)]
    # Each fit chooses weights of its own, which changes the sum by a few per mille.
    assert squares[0] < 1.01 * squares[1]


@pytest.mark.parametrize("kind", KINDS)
def test_the_simulator_makes_the_error_of_the_base_model(
    kind: str, beside_pixels: Callable[[str], Study]
) -> None:
    study = beside_pixels(kind)
    twin = Evidence(study=study, named=unnamed(study)).distance()
    fitted = study.observations.measured - study.residual_of(())
    # Tables have knots, and a delay changes the amplitude that the next one depends on.
    assert float((twin - fitted).square().mean().sqrt()) < 3e-4


def test_a_fixed_pattern_in_the_base_is_not_named(folder: Path) -> None:
    recording = recorded(folder / "base_pattern", 45, [PATTERN])
    paper = ("distance_polynomial", "pixel_polynomial", "amplitude_polynomial")
    without, with_pattern = (
        name_effects(_study(recording, *kinds, catalogue=PATTERNS))
        for kinds in (paper, (*paper, "fixed_pattern"))
    )
    assert without.names == ("fixed_pattern",)
    assert with_pattern.names == ()
    assert not {"fixed_pattern", "row_column_pattern"} & set(with_pattern.ranking)


def test_an_integration_time_term_of_the_base_takes_the_effect(time_missing: Recording) -> None:
    paper = ("distance_polynomial", "pixel_polynomial", "amplitude_polynomial")
    few = ["integration_time", "ambient_light", "incidence_angle"]
    study = _study(time_missing, *paper, catalogue=few)
    assert name_effects(study).names == ("integration_time",)
    terms = [*({"kind": kind} for kind in paper), {"kind": "integration_time", "degree": 2}]
    # Three settings of the integration time: two coefficients describe any error of it.
    study = _study(time_missing, base={"terms": terms}, catalogue=few)
    assert name_effects(study).names == ()


def test_amplitude_terms_are_left_out_of_a_recording_without_amplitudes(
    nothing_missing: Recording, tmp_path: Path
) -> None:
    bare = copytree(nothing_missing.path, tmp_path / "bare")
    (bare / "amplitude.npy").unlink()
    base = _base("distance_polynomial", "tensor_spline")
    found = diagnose(bare, config=base | {"catalogue": ["wiggling"]})
    assert "amplitude.npy is missing" in found.warnings[0]
    assert "tensor_spline" in found.warnings[0]
