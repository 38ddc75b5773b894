"""The `tofcorr` command: lists its sub-commands and turns errors into one readable message."""

import os
import signal
import sys
import threading
from collections.abc import MutableMapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

import click

from tofcorr.cli.shared import LazyGroup
from tofcorr.errors import TofcorrError, printable
from tofcorr.files import remove_begun
from tofcorr.version import __version__

COMMANDS = {
    "example": ("record", "Write small real-looking input to try the other commands with."),
    "poses": ("record", "Propose robot poses to record, before any recording exists."),
    "simulate": ("simulate", "Draw a recording from the sensor simulator."),
    "import": ("record", "Turn recorded images into a recording."),
    "inspect": ("calibrate", "Say what is odd about a recording, before any fit."),
    "watch": ("calibrate", "Show in the browser what a recording tells while it grows."),
    "train": ("calibrate", "Calibrate a recording: distance, pixel, intensity error, hand-eye."),
    "update": ("calibrate", "Carry a calibration on with a few frames, and say what has changed."),
    "pool": ("calibrate", "Find what cameras of one type share, as the prior of the next one."),
    "rig": ("calibrate", "Calibrate several cameras of one robot together, and its joints."),
    "evaluate": ("calibrate", "Compare models on held-out images, in the paper's two tables."),
    "select": ("calibrate", "Choose the model that predicts best what it has not seen."),
    "compare": ("calibrate", "Show several runs side by side: errors, hand-eye, options."),
    "check": ("calibrate", "Say whether a calibration still holds, from a few frames of any wall."),
    "export": ("correct", "Write the calibration of a run for robots: corrector, URDF, tf, ..."),
    "correct": ("correct", "Correct a recording with a trained corrector; also as point clouds."),
    "diagnose": ("simulate", "Say where simulator and recording differ; name the missing effect."),
    "degrade": ("simulate", "Give ideal depth frames the errors, noise and gaps of a real camera."),
    "configs": ("main", "List the shipped configurations, or print one."),
}
"""By name: the file here that holds the command, and its line in the list of commands."""

_EPILOG = """\b
Completion of commands, options and configurations, in the start-up file of your shell:
  bash:  eval "$(_TOFCORR_COMPLETE=bash_source tofcorr)"
  zsh:   eval "$(_TOFCORR_COMPLETE=zsh_source tofcorr)"
  fish:  _TOFCORR_COMPLETE=fish_source tofcorr | source
"""


@click.group(
    cls=LazyGroup,
    lazy={name: (f"cli.{file}:{name}_command", said) for name, (file, said) in COMMANDS.items()},
    epilog=_EPILOG,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="tofcorr")
def group() -> None:
    """Correct time-of-flight depth, and find out why a simulator disagrees with it."""


def _open_closed_streams() -> None:
    """Send what is said nowhere if the caller closed standard output or error.

    Otherwise the next file that is opened takes the stream's number, and gets what is said.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115


_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_TOLD_TO_END = threading.Event()


def main() -> None:
    """Run the command line; exit with 2 and one message on anything the user can mend."""
    _TOLD_TO_END.clear()
    _open_closed_streams()
    try:
        # Being told to end is handled as Ctrl-C is: what was begun is removed.
        signal.signal(signal.SIGTERM, _stop)
        # In the background of a shell Ctrl-C is ignored; it stays so.
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _stop)
        set_up_threads(os.environ)
        _run()
    except (click.Abort, KeyboardInterrupt):
        _end_interrupted()
    except Exception:
        # A library that is told to end while it is imported may raise an error of its own instead.
        if not _TOLD_TO_END.is_set():
            raise
        _end_interrupted()


def set_up_threads(environment: MutableMapping[str, str], quota: Path = _QUOTA) -> None:
    """Let waiting threads sleep, and start no more of them than a container may run.

    OpenMP's threads otherwise spin while they wait, and hold cores that other programs need: one
    addition of a frame took 11 ms in place of 0.8 ms. NumPy's products run in one thread each: the
    program's own threads share them out. What the user has set is kept.

    Args:
        environment: Where to set the variables; torch reads those of the process when it is loaded.
        quota: The file in which Linux states the microseconds of use, and of the period.
    """
    if not environment.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"}:
        environment["OMP_WAIT_POLICY"] = "passive"
    environment.setdefault("OPENBLAS_NUM_THREADS", "1")
    with suppress(OSError, ValueError):  # Another system, or "max": no limit.
        used, period = quota.read_text(encoding="ascii").split()
        if int(used) < int(period) * (os.cpu_count() or 1):
            environment.setdefault("OMP_NUM_THREADS", str(max(1, int(used) // int(period))))


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Handle a signal: threads whose files are about to be removed have nothing to say."""
    _TOLD_TO_END.set()
    threading.excepthook = lambda arguments: None
    raise KeyboardInterrupt


def _end_interrupted() -> NoReturn:
    for impatient in (signal.SIGINT, signal.SIGTERM):
        signal.signal(impatient, signal.SIG_IGN)  # Removing takes less than a second.
    remove_begun()
    click.echo("Interrupted; nothing half-written was left.", err=True)
    sys.exit(130)


def _run() -> None:
    try:
        group(standalone_mode=False)
    except click.exceptions.Exit as done:
        sys.exit(done.exit_code)
    except click.ClickException as error:
        error.show()
    except TofcorrError as error:
        click.echo(f"Error: {error}", err=True)
    except OSError as error:  # A full disk, a folder without permission: the user's to mend.
        where = "" if error.filename is None else f"{error.filename}: "
        click.echo(printable(f"Error: {where}{error.strerror or error}."), err=True)
    else:
        return
    sys.exit(2)


@click.command()
@click.argument("name", required=False)
def configs_command(name: str | None) -> None:
    """List the shipped configurations, or print the one called NAME.

    The folders are the commands that read them; a folder's name lists it alone. Where two folders
    have one of the same name, write FOLDER/NAME, such as train/ea. To edit one, save it to a file:
    tofcorr configs ea > mine.yaml
    """
    from tofcorr.errors import ConfigError, did_you_mean
    from tofcorr.options import configs_folder

    files = sorted(configs_folder().glob("*/*.yaml"))
    every = {f"{file.parent.name}/{file.stem}": file for file in files}
    folders = dict.fromkeys(file.parent.name for file in files)
    if name is None or name in folders:
        listed = [_listing(folder, files) for folder in folders if name in (None, folder)]
        click.echo("\n\n".join(listed))
        return
    matches = [one for one, file in every.items() if name in (one, file.stem)]
    if len(matches) > 1:
        raise ConfigError(f"'{name}' stands for {' and '.join(matches)}; name one of them.")
    if not matches:
        hint = did_you_mean(name, [*every, *(file.stem for file in files)])
        raise ConfigError(f"no configuration '{name}' is shipped.{hint} List: tofcorr configs")
    click.echo(every[matches[0]].read_text(encoding="utf-8"), nl=False)


def _listing(folder: str, files: Sequence[Path]) -> str:
    """Return the names of a folder's configurations, each with its first line."""
    own = [file for file in files if file.parent.name == folder]
    width = max(len(file.stem) for file in own)
    texts = [file.read_text(encoding="utf-8").partition("\n")[0] for file in own]
    lines = [text.removeprefix("#").strip() for text in texts]
    listed = (f"  {one.stem:<{width}}  {line}" for one, line in zip(own, lines, strict=True))
    return "\n".join([f"{folder}:", *listed])
