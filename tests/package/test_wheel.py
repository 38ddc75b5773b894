"""The wheel alone suffices: built, installed in an environment of its own, run elsewhere."""

import json
import zipfile
from pathlib import Path

from running import printed_alone

ROOT = Path(__file__).resolve().parents[2]


# In one process, which loads torch once.
SIMULATE_AND_TRAIN = """
from tofcorr.cli.main import group
for words in (
    "simulate --config demo --frames 16 --out recording",
    "train --config ea --set solver.max_iterations=30 --recording recording --no-figures --out run",
):
    group(words.split(), standalone_mode=False)
"""


def test_the_wheel_holds_every_configuration_and_text_as_in_the_repository(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name: archive.read(name) for name in archive.namelist()}
    for path in (ROOT / "configs").glob("*/*.yaml"):
        assert packed[f"tofcorr/configs/{path.parent.name}/{path.name}"] == path.read_bytes()
    assert "tofcorr/py.typed" in packed
    shown = {f"tofcorr/pages/{name}" for name in ("page.html.j2", "style.css", "cloud.js")}
    assert shown | {"tofcorr/__init__.pyi"} <= packed.keys()
    assert any(name.endswith("/licenses/LICENSE") for name in packed)
    metadata = next(text for name, text in packed.items() if name.endswith("/METADATA")).decode()
    assert "\nLicense-Expression: Apache-2.0\n" in metadata
    assert "\nAuthor: The tofcorr authors\n" in metadata
    of_wheel = f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"
    assert {name.partition("/")[0] for name in packed} == {"tofcorr", of_wheel}


def test_simulate_and_train_run_by_name_in_an_empty_folder(
    python_with_wheel: Path, tmp_path: Path
) -> None:
    where = "import sys, tofcorr; print(tofcorr.__file__); print(*sys.path, sep='\\n')"
    package, *search_path = printed_alone(python_with_wheel, tmp_path, "-c", where).splitlines()
    assert Path(package).is_relative_to(python_with_wheel.parents[1])
    assert str(ROOT) not in search_path

    shipped = (ROOT / "configs" / "train" / "ea.yaml").read_text("utf-8")
    assert printed_alone(python_with_wheel, tmp_path, "-m", "tofcorr", "configs", "ea") == shipped
    printed = printed_alone(python_with_wheel, tmp_path, "-c", SIMULATE_AND_TRAIN)
    assert "Written to run: " in printed
    report = json.loads((tmp_path / "run" / "report.json").read_text("utf-8"))
    assert report["model"] == "EA"
    assert report["iterations"] <= 30
    assert (tmp_path / "run" / "corrector.ts").is_file()
    assert "max_iterations: 30" in (tmp_path / "run" / "config.yaml").read_text("utf-8")
