"""`tofcorr configs`, and configurations by name and by key on the command line."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from running import Program

from tofcorr.cli.main import COMMANDS
from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.importing.registry import IMPORTERS
from tofcorr.options import Options, resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.training.calibration import TrainingOptions

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FILES = sorted(CONFIGS.glob("*/*.yaml"))
PROGRAM = Path(sys.executable).with_name("tofcorr")


def test_the_list_names_every_shipped_file_with_its_first_line(program: Program) -> None:
    code, printed, _ = program("configs")
    assert code == 0
    listed = {
        f"{folder.rstrip(':')}/{line.split()[0]}": line.split(maxsplit=1)[1]
        for folder, *lines in map(str.splitlines, printed.split("\n\n"))
        for line in lines
    }
    assert listed == {
        f"{path.parent.name}/{path.stem}": path.read_text(encoding="utf-8").splitlines()[0][2:]
        for path in FILES
    }
    assert program("configs", "train")[1] in printed


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_the_first_line_of_a_configuration_is_one_short_sentence(path: Path) -> None:
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("# ")
    assert first.endswith(".")
    assert len(first) <= 92


@pytest.mark.parametrize(
    ("name", "file"),
    [("ea", "train/ea"), ("train/ea", "train/ea"), ("import/kinect2", "import/kinect2")],
)
def test_a_configuration_is_printed_as_it_is(program: Program, name: str, file: str) -> None:
    code, printed, _ = program("configs", name)
    assert code == 0
    assert printed == (CONFIGS / f"{file}.yaml").read_text(encoding="utf-8")


WRONG = {
    "configs paper": "'paper' stands for evaluate/paper and select/paper; name one",
    "configs ladde": "no configuration 'ladde' is shipped. Did you mean 'ladder'?",
    "train --config eaa --recording r --out o": "Did you mean 'ea'?",
    "train --set solver.max_iteration=3 --recording r --out o": "Did you mean 'max_iterations'?",
    "train --config none.yaml --recording x --out y": "none.yaml",
    "evaluate --set folds --recording r --out o": "expected KEY=VALUE",
    "select --config papr --recording r --out o": "Did you mean 'paper'?",
    "simulate --config dmo --out o": "Did you mean 'demo'?",
    "simulate --out o": "Missing option '--config'",
    "diagnose --set sed=2 --recording r --out o": "Did you mean 'seed'?",
    "trian": "No such command 'trian'. Did you mean 'train'?",
    "export --run a --format npzz --out b": "Did you mean 'npz'?",
    "no-such-command": "No such command 'no-such-command'",
    "import polaroid": "No such command 'polaroid'",
    "correct --modle x": "No such option",
    "correct --model a --recording b --out c": "b: there is no such folder",
    "diagnose --recording b --out c": "b: there is no such folder",
    "export --run a --format lut --out b": "state.pt: there is no such",
    "import checkerboard . --out o --board 5x7 --square-mm 30 --intrinsics kinect": (
        "neither a file nor a configuration shipped for 'import'. Did you mean 'kinect2'?"
    ),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_ends_with_two_and_a_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, printed = program(*words.split())
    assert code == 2
    assert WRONG[words] in printed
    assert "Traceback" not in printed
    assert list(tmp_path.iterdir()) == []


def test_simulate_takes_a_name_and_changes(tmp_path: Path, program: Program) -> None:
    changes = ["--set", "camera.width=9", "--set", "camera.height=7", "--set", "shots.0.poses=2"]
    out = tmp_path / "r"
    code, _, _ = program("simulate", "--config", "demo", *changes, "--frames", "2", "--out", out)
    assert code == 0
    written = yaml.safe_load((out / "truth" / "options.yaml").read_text())
    shipped = yaml.safe_load((CONFIGS / "simulate/demo.yaml").read_text())
    assert (written["camera"]["width"], written["camera"]["height"]) == (9, 7)
    assert written["camera"]["K"] == shipped["camera"]["K"]
    assert written["shots"][0]["poses"] == 2


def completed(words: str, shell: str = "bash") -> list[str]:
    """Return what the shell offers at the end of `words`."""
    typed = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    environment = os.environ | typed | {"_TOFCORR_COMPLETE": f"{shell}_complete"}
    done = subprocess.run([PROGRAM], env=environment, capture_output=True, text=True, check=False)
    return done.stdout.split("\n")[:-1]


def test_the_shell_completes_commands_and_configurations_and_says_what_they_are() -> None:
    assert completed("tofcorr ev") == ["plain,evaluate"]
    logarithmic, *others = completed("tofcorr train --config ea_")
    assert logarithmic == "plain,ea_log"
    assert others == ["plain,ea_residual", "plain,ea_robust"]
    assert completed("tofcorr train --config ./e") == ["file,./e"]
    assert completed("tofcorr ev", "zsh") == ["plain", "evaluate", COMMANDS["evaluate"][1]]
    importer = IMPORTERS["bop"]
    assert completed("tofcorr import bo", "zsh") == ["plain", "bop", importer]


def test_the_module_is_the_same_program(tmp_path: Path) -> None:
    by_module, by_program = (
        subprocess.check_output([*program, "configs", "ea"], cwd=tmp_path)
        for program in ((sys.executable, "-m", "tofcorr"), (PROGRAM,))
    )
    assert by_module == by_program


KINDS: dict[str, tuple[type[Options], str]] = {
    "train": (TrainingOptions, "ea"),
    "poses": (TrainingOptions, "ea"),
    "evaluate": (EvaluationOptions, "paper"),
    "select": (SelectionOptions, "paper"),
    "simulate": (SimulatorOptions, "demo"),
    "diagnose": (DiagnosisOptions, "default"),
}


@pytest.mark.parametrize("command", KINDS)
def test_the_changed_option_that_the_help_shows_is_one_of_the_command(
    program: Program, command: str
) -> None:
    options, config = KINDS[command]
    # `tofcorr simulate --help` once showed an option of the training.
    _, printed, _ = program(command, "--help")
    example = re.search(r"such as --set\s+(\S+=\S+);", printed)
    assert example is not None
    assert resolve_options(options, config, [example[1]]) != resolve_options(options, config)
