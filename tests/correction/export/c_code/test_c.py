"""The corrector in C gives what the float64 model gives, pixel by pixel."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cameras
import numpy as np
import pytest
import torch
from correction.export.c_code.models import STATES, exported, hard_frames
from correction.export.states import TRANSFORMS, calibration, write
from kinds_of_terms import DOMAIN

from tofcorr.correction.export.c import load_c
from tofcorr.correction.export.parity import Correct
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError
from tofcorr.geometry.camera import CameraIntrinsics

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")


def _require_same(correct: Correct, state: CalibrationState, frames: tuple[Any, Any]) -> None:
    """Compare depths to 1e-6 m, and validity exactly: there is no pixel in doubt."""
    corrected, valid = correct(*frames)
    expected, expected_valid = state.corrected(*frames)
    # Beyond 10 m float32 resolves no micrometre: there, half a step of it.
    torch.testing.assert_close(
        corrected.double(), expected, rtol=6e-8, atol=1e-6, equal_nan=True, check_dtype=False
    )
    assert torch.equal(valid, expected_valid)


@pytest.mark.parametrize("name", STATES)
def test_every_kind_of_term_is_corrected_as_by_the_model(name: str, tmp_path: Path) -> None:
    state, path = exported(name, "z" if len(name) % 2 else "radial", tmp_path)
    _require_same(load_c(path), state, hard_frames(state, 100, seed=7))


def test_a_frame_alone_and_in_a_batch_are_the_same(tmp_path: Path) -> None:
    state, path = exported("network", "radial", tmp_path)
    depth, amplitude = hard_frames(state, 3, seed=5)
    correct = load_c(path)
    together, alone = correct(depth, amplitude), correct(depth[1], amplitude[1])
    np.testing.assert_array_equal(together[0][1], alone[0])
    np.testing.assert_array_equal(together[1][1], alone[1])


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc reports what it vectorises")
@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_every_loop_over_pixels_is_vectorised(depth_kind: Any, tmp_path: Path) -> None:
    small = calibration(TRANSFORMS["general"], depth_kind=depth_kind)
    camera = CameraIntrinsics(width=640, height=4, matrix=small.camera.matrix)
    domain = replace(small.domain, height=4, width=640)
    write("c", small.model_copy(update={"camera": camera, "domain": domain}), tmp_path / "camera.c")
    source = (tmp_path / "camera.c").read_text().splitlines()
    loops = {k for k, line in enumerate(source, start=1) if "for (i = 0;" in line}
    report = _run("gcc", "-std=c99", "-O3", "-fopt-info-vec", "-c", "camera.c", folder=tmp_path)
    vectorised = {int(k) for k in re.findall(r"c:(\d+):\d+: optimized: loop", report.stderr)}
    assert loops
    assert loops <= vectorised


def test_the_metadata_in_c_are_those_of_the_corrector(tmp_path: Path) -> None:
    state = calibration(TRANSFORMS["general"], name='E"A\\ */ ü')
    write("c", state, tmp_path / "camera.c")
    (tmp_path / "say.c").write_text(
        '#include "camera.h"\n#include <stdio.h>\n'
        "int main(void) { return puts(camera_metadata()) < 0; }\n"
    )
    _run("cc", "-std=c99", "camera.c", "say.c", "-o", "say", folder=tmp_path)
    from tofcorr.correction.corrector import DepthCorrector

    said = _run("./say", folder=tmp_path).stdout
    assert said == DepthCorrector.from_state(state).metadata() + "\n"


@pytest.mark.parametrize("name", ["camera.h", "front-camera.c", "2nd.c"])
def test_a_name_that_is_none_in_c_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected a name such as \w+\.c, of letters, digits"):
        write("c", calibration(TRANSFORMS["general"]), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_without_a_compiler_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(ConfigError, match=r"no C compiler was found: install gcc or clang\."):
        write("c", calibration(TRANSFORMS["general"]), tmp_path / "camera.c")
    assert not list(tmp_path.iterdir())


def test_a_term_that_no_pieces_follow_is_refused_with_formats_that_hold_it(tmp_path: Path) -> None:
    # The error has 128 periods over 15 mm.
    terms = [{"kind": "periodic", "harmonics": 8, "fundamental": 16}]
    fast = replace(DOMAIN, modulation_frequency=1e10)
    with pytest.raises(ConfigError, match=r"periodic changes too quickly .* export torchscript"):
        write("c", calibration(terms=terms, domain=fast), tmp_path / "camera.c")
    assert not list(tmp_path.iterdir())


_SANITIZERS = ("-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover")
_STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


@pytest.mark.slow
@pytest.mark.parametrize("flags", [("-O3",), ("-O3", "-fopenmp"), ("-O1", *_SANITIZERS)], ids=str)
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", STATES)
def test_strict_compilers_and_sanitizers_find_nothing(
    name: str, compiler: str, flags: tuple[str, ...], tmp_path: Path
) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    if compiler == "clang" and "-fopenmp" in flags:
        pytest.skip("clang's OpenMP is a package of its own")
    for depth_kind in ("radial", "z"):
        exported(name, depth_kind, tmp_path)
        words = ("camera.c", "camera_test.c", "-o", "camera_test", "-lm")
        _run(compiler, *_STRICT, *flags, *words, folder=tmp_path)
        assert " 0 differ in validity" in _run("./camera_test", folder=tmp_path).stdout


@pytest.mark.slow
@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_forty_two_frames_of_a_whole_sensor_are_corrected_as_by_the_model(
    depth_kind: str, tmp_path: Path
) -> None:
    kinds = ("distance_polynomial", "tensor_spline", "pixel_polynomial", "fixed_pattern")
    terms = [{"kind": kind} for kind in kinds]
    terms.append({"kind": "amplitude_polynomial", "variable": "normalised_amplitude"})
    base = calibration(terms=terms, depth_kind=depth_kind)
    lens, size = (-0.05, 0.01, 0.001, -0.002), (645, 480)  # No multiple of a vector or block.
    camera = cameras.camera(size, (500.0, 500.0), (322.0, 239.5), *lens)
    domain = replace(base.domain, height=480, width=645)
    pattern = torch.randn(480, 645, generator=torch.Generator().manual_seed(1)).double()
    whole = {"camera": camera, "domain": domain, "fixed_pattern": 0.01 * pattern}
    state = base.model_copy(update=whole)
    write("c", state, tmp_path / "camera.c")
    _require_same(load_c(tmp_path / "camera.c", ["-O3"]), state, hard_frames(state, 42, seed=17))


def _run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done
