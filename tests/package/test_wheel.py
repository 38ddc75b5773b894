"""The wheel alone suffices: built, installed in an environment of its own, run elsewhere."""

import json
import os
import shutil
import site
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from running import printed

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("tofcorr", "configs", "pyproject.toml", "setup.py", "MANIFEST.in", "README.md")
TEXTS = ("LICENSE", "CHANGELOG.md", "CITATION.cff")


# In one process, which loads torch once.
SIMULATE_AND_TRAIN = """
from tofcorr.cli.main import group
for words in (
    "simulate --config demo --frames 16 --out recording",
    "train --config ea --set solver.max_iterations=30 --recording recording --no-figures --out run",
):
    group(words.split(), standalone_mode=False)
"""


def run(python: Path | str, folder: Path, *arguments: str) -> str:
    """Return what `python ARGUMENTS` prints, run in `folder` as a user without the repository.

    With the repository in PYTHONPATH, its `tofcorr.egg-info` passed for an installed tofcorr, and
    pip installed nothing.
    """
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    return printed(python, *arguments, cwd=folder, env=clean)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a source distribution from a copy of the repository, and the wheel from that."""
    source = tmp_path_factory.mktemp("source")
    for name in (*SOURCES, *TEXTS):
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / name, source / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source)
    run(sys.executable, source, "-m", "build", "--no-isolation", "--outdir", "dist")
    return next((source / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of a new environment that holds the wheel.

    The packages that tofcorr needs come from the environment of the tests, by a path put behind
    the new environment's own. That path brings no tofcorr: an editable install is a `.pth` file,
    which Python reads in its own site-packages only.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    new = next(path for path in folder.rglob("python*") if path.stem == "python")
    pip = ("-m", "pip", "--python", str(new), "install", "--no-deps", "--no-index", "--no-compile")
    run(sys.executable, folder, *pip, str(wheel))
    packages = next(folder.rglob("site-packages"))
    (packages / "packages_of_the_tests.pth").write_text("\n".join(site.getsitepackages()))
    return new


def test_the_wheel_holds_every_configuration_and_text_as_in_the_repository(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name: archive.read(name) for name in archive.namelist()}
    for path in (ROOT / "configs").glob("*/*.yaml"):
        assert packed[f"tofcorr/configs/{path.parent.name}/{path.name}"] == path.read_bytes()
    assert "tofcorr/py.typed" in packed
    assert {"tofcorr/diagnosis/report/report.html.j2", "tofcorr/__init__.pyi"} <= packed.keys()
    assert any(name.endswith("/licenses/LICENSE") for name in packed)
    metadata = next(text for name, text in packed.items() if name.endswith("/METADATA")).decode()
    assert "\nLicense-Expression: Apache-2.0\n" in metadata
    assert "\nAuthor: The tofcorr authors\n" in metadata
    of_wheel = f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"
    assert {name.partition("/")[0] for name in packed} == {"tofcorr", of_wheel}


def test_simulate_and_train_run_by_name_in_an_empty_folder(python: Path, tmp_path: Path) -> None:
    where = "import sys, tofcorr; print(tofcorr.__file__); print(*sys.path, sep='\\n')"
    package, *search_path = run(python, tmp_path, "-c", where).splitlines()
    assert Path(package).is_relative_to(python.parents[1])
    assert str(ROOT) not in search_path

    shipped = (ROOT / "configs" / "train" / "ea.yaml").read_text("utf-8")
    assert run(python, tmp_path, "-m", "tofcorr", "configs", "ea") == shipped
    printed = run(python, tmp_path, "-c", SIMULATE_AND_TRAIN)
    assert "Written to run: " in printed
    report = json.loads((tmp_path / "run" / "report.json").read_text("utf-8"))
    assert report["model"] == "EA"
    assert report["iterations"] <= 30
    assert (tmp_path / "run" / "corrector.ts").is_file()
    assert "max_iterations: 30" in (tmp_path / "run" / "config.yaml").read_text("utf-8")
