"""The commands that use a calibration: correct whole recordings, export it for robots."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tofcorr.cli.shared import FOLDER, option, out_option, recording_option, run_option
from tofcorr.correction.export.registry import FORMATS, format_named
from tofcorr.errors import CalibrationDataError, ConfigError, TofcorrError
from tofcorr.files import NewPath, file_in_new_folder, new_folders, write_text

if TYPE_CHECKING:
    from tofcorr.correction.metadata import CorrectorMetadata
    from tofcorr.data.recording import Recording

_CLOUDS = "Folder of point clouds, made anew: frame_000_before.ply, frame_000_after.ply, ..."
_FORMATS = " ".join(f"{one.name} ({one.ending}): {one.summary}." for one in FORMATS.values())


class _FormatName(click.Choice[str]):
    """The name of an export format, or another name for it."""

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the name that the format is registered by."""
        return format_named(value).name


@click.command()
@option(
    "--model", "A run, its corrector.ts, or another file that corrects.", required=True, type=FOLDER
)
@recording_option("Folder of the recording to correct.")
@option("--trust-model", "Run the program of a .ts or .pt2 whose origin you know.", is_flag=True)
@option("--out", "Folder of the corrected recording, made anew.", type=NewPath())
@option("--ply", _CLOUDS, type=NewPath())
def correct_command(
    model: Path, recording_path: Path, trust_model: bool, out: Path | None, ply: Path | None
) -> None:
    """Write a recording anew with corrected depth, its point clouds, or both.

    The rows, the camera and the amplitude stay as they are; depth is NaN where there was no
    return. The mask keeps the pixels whose distance and amplitude lie in the calibrated range.
    Raw samples are left out: they would disagree with the corrected depth. Point clouds are in the
    camera's frame, metres: x right, y down, z forward.
    """
    from tofcorr.data.recording import Recording
    from tofcorr.data.writing import write_corrected, write_point_clouds
    from tofcorr.module.loading import load_corrector

    if out is None and ply is None:
        raise click.UsageError("Nothing to write: give --out, --ply, or both.")
    if out == ply:
        raise click.UsageError("--out and --ply name the same folder; choose another for one.")
    # Contents are checked as the frames pass by; the recording may be larger than memory.
    recording = Recording.open(recording_path, check_contents=False)
    corrector = load_corrector(model, trust=trust_model)
    _refuse_another_camera(corrector.known, recording, model)
    with _refused_by(model):
        if out is not None:
            share = write_corrected(corrector, recording, out)
            if recording.raw is not None:
                left_out = "raw.npy was left out: it would disagree with the corrected depth."
                click.echo(left_out, err=True)
            inside = f"{share:.1%} of the pixels with a return lie in the calibrated range"
            click.echo(f"{out}: {recording.num_frames} frames corrected; {inside}.")
        if ply is not None:
            write_point_clouds(corrector, recording, ply)
            click.echo(f"{ply}: point clouds of {recording.num_frames} frames, before and after.")


@contextmanager
def _refused_by(model: Path) -> Iterator[None]:
    """Turn the corrector's own refusals into one sentence."""
    import torch

    scripted = getattr(getattr(torch, "jit", None), "Error", ValueError)
    try:
        yield
    except TofcorrError:  # Of the recording or the folder: it is one sentence already.
        raise
    except (RuntimeError, ValueError, scripted) as error:
        # TorchScript puts the message behind its traceback, after such as builtins.ValueError.
        last = (str(error).strip() or type(error).__name__).splitlines()[-1].strip()
        said = re.sub(r"^[A-Za-z_][\w.]*: ", "", last)
        raise CalibrationDataError(f"{model}: {said}") from None


def _refuse_another_camera(
    metadata: "CorrectorMetadata", recording: "Recording", model: Path
) -> None:
    """Refuse a recording that the corrector was not made for."""
    if metadata.depth_kind not in (recording.depth_kind, None):
        kinds = f"'{recording.depth_kind}', but {model} corrects '{metadata.depth_kind}'"
        raise CalibrationDataError(f"{recording.path}: depth is of kind {kinds}: another camera?")
    camera, made_for = recording.camera, metadata.camera
    size = (made_for.width or camera.width, made_for.height or camera.height)
    if size != (camera.width, camera.height):
        frames = f"frames are {camera.width}x{camera.height} pixels"
        said = f"{frames}, but {model} was made for {size[0]}x{size[1]}"
        raise CalibrationDataError(f"{recording.path}: {said}.")
    lens = (made_for.K, made_for.distortion)
    if lens not in ((camera.matrix, camera.distortion), (None, None)):
        other = f"{recording.path} has another lens calibration than {model} was made with"
        click.echo(f"Warning: {other}; does the same camera have the same lens?", err=True)
    if metadata.needs_amplitude:
        recording.require("amplitude", f"the corrector {model}")


@click.command()
@run_option
@option("--format", _FORMATS, "name", required=True, type=_FormatName(list(FORMATS)))
@out_option("File to write; an older one is replaced.", NewPath(file_in_new_folder, "file"))
@option("--device", "What pt2 is compiled for: cpu or cuda.", default="cpu")
def export_command(run: Path, name: str, out: Path, device: str) -> None:
    """Write the corrector of a run, once it agrees with the calibration, or the camera's pose.

    Nothing is written when it does not, nor of a run whose verdict is `do not use`, unless it was
    trained with --force. Of the folder of `tofcorr rig --urdf`, the format urdf writes the robot's
    description with the offsets of its joints.
    """
    import torch

    from tofcorr.correction.corrector import DepthCorrector
    from tofcorr.correction.export import export
    from tofcorr.correction.state import STATE_FILE, load_calibration
    from tofcorr.options import read_text
    from tofcorr.training.judgement import verdict_of_run
    from tofcorr.training.rig import ROBOT_FILE

    if device != "cpu" and not (FORMATS[name].for_device and torch.cuda.is_available()):
        compiled = " and ".join(one.name for one in FORMATS.values() if one.for_device)
        raise ConfigError(f"--device {device}: only for {compiled}, on a machine that has it.")
    if (robot := run / ROBOT_FILE).is_file() and name == "urdf":
        write_text(out, read_text(robot))
        click.echo(f"{out}: the robot of {run}, with the offsets of its joints.")
        return
    verdict = verdict_of_run(run)
    state = load_calibration(run / STATE_FILE)
    with new_folders(out.parent):
        export(name, DepthCorrector.from_state(state).to(device), out, state)
    click.echo(f"{out}: the calibration {state.name} of {run} as {name}. {verdict}".rstrip())
