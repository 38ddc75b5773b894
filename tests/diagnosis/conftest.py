"""Recordings that several tests look at; simulated once."""

from pathlib import Path

import pytest
from diagnosed_recordings import TIME, recorded

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import diagnose, prepare
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import DiagnosisResult, render
from tofcorr.diagnosis.sums.study import Study

OPTIONS = DiagnosisOptions(bootstraps=40)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("diagnosis")


@pytest.fixture(scope="session")
def nothing_missing(folder: Path) -> Recording:
    return recorded(folder / "nothing_missing", 31)


@pytest.fixture(scope="session")
def time_missing(folder: Path) -> Recording:
    return recorded(folder / "time_missing", 32, [TIME])


@pytest.fixture(scope="session")
def nothing_study(nothing_missing: Recording) -> Study:
    return prepare(nothing_missing, OPTIONS, None).study


@pytest.fixture(scope="session")
def time_study(time_missing: Recording) -> Study:
    return prepare(time_missing, OPTIONS, None).study


@pytest.fixture(scope="session")
def nothing_named(nothing_study: Study) -> NamedEffects:
    return name_effects(nothing_study)


@pytest.fixture(scope="session")
def time_diagnosis(time_missing: Recording) -> DiagnosisResult:
    return diagnose(time_missing, config=OPTIONS)


@pytest.fixture(scope="session")
def page(time_diagnosis: DiagnosisResult) -> str:
    return render(time_diagnosis)


@pytest.fixture(scope="session")
def time_named(time_diagnosis: DiagnosisResult) -> NamedEffects:
    return time_diagnosis.evidence.named
