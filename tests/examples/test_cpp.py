"""The C++ example corrects as Python does."""

import hashlib
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from examples.correctors import HEIGHT, WIDTH, save_corrector
from filelock import FileLock
from running import printed

SOURCE = Path(__file__).resolve().parents[2] / "examples" / "cpp"

pytestmark = pytest.mark.skipif(
    not (shutil.which("cmake") and shutil.which("g++")), reason="needs cmake and g++"
)


@pytest.fixture(scope="module")
def program(pytestconfig: pytest.Config) -> Path:
    """Build the program; a build of the same sources and the same torch is used again.

    torch's headers take a quarter of a minute to compile.
    """
    prefix = torch.utils.cmake_prefix_path
    made_of = [torch.__version__, prefix, *(path.read_text() for path in sorted(SOURCE.iterdir()))]
    name = hashlib.sha256("\0".join(made_of).encode()).hexdigest()
    build = pytestconfig.cache.mkdir("cpp_example") / name
    with FileLock(f"{build}.lock"):  # Another worker may be at it.
        printed("cmake", "-S", SOURCE, "-B", build, f"-DCMAKE_PREFIX_PATH={prefix}")
        printed("cmake", "--build", build)
    return build / "correct_frame"


@pytest.fixture(scope="module")
def corrector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_corrector(tmp_path_factory.mktemp("corrector") / "corrector.ts")


@pytest.mark.slow
def test_cpp_program_gives_the_very_bits_that_python_gives(
    program: Path, corrector: Path, tmp_path: Path
) -> None:
    random = np.random.default_rng(0)
    frames = {
        "depth": random.uniform(0.3, 2.4, (HEIGHT, WIDTH)).astype(np.float32),
        "amplitude": random.uniform(5, 600, (HEIGHT, WIDTH)).astype(np.float32),
    }
    frames["depth"][0, :2] = (np.nan, 0.0)
    for name, frame in frames.items():
        frame.tofile(tmp_path / f"{name}.raw")
    said = printed(program, corrector, *(tmp_path / f"{n}.raw" for n in (*frames, "out")))
    expected, valid = torch.jit.load(str(corrector))(*map(torch.from_numpy, frames.values()))
    found = np.fromfile(tmp_path / "out.raw", np.float32).reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(found, expected.numpy())
    assert said == f"{int(valid.sum())} of {HEIGHT * WIDTH} pixels valid\n"


@pytest.mark.slow
def test_cpp_program_refuses_a_frame_of_another_size_in_one_line(
    program: Path, corrector: Path, tmp_path: Path
) -> None:
    np.zeros((HEIGHT, WIDTH - 1), np.float32).tofile(tmp_path / "small.raw")
    small = tmp_path / "small.raw"
    words = [program, corrector, small, small, tmp_path / "out.raw"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"expected {HEIGHT} x {WIDTH} float32 values" in done.stderr
    assert not (tmp_path / "out.raw").exists()
