"""`tofcorr correct`: apply a trained corrector to a whole recording."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tofcorr.errors import CalibrationDataError
from tofcorr.files.arguments import NewPath
from tofcorr.progress import bar

if TYPE_CHECKING:
    from torch.jit import ScriptModule

    from tofcorr.correction.metadata_file import CorrectorMetadata
    from tofcorr.data.recording import Recording


@click.command()
@click.option(
    "--model",
    required=True,
    type=click.Path(path_type=Path),
    help="The corrector.ts of a run.",
)
@click.option(
    "--recording",
    "recording_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of the recording to correct.",
)
@click.option(
    "--out",
    type=NewPath(),
    help="Folder of the corrected recording, made anew.",
)
@click.option(
    "--ply",
    type=NewPath(),
    help="Folder of point clouds, made anew: frame_000_before.ply, frame_000_after.ply, ...",
)
def command(model: Path, recording_path: Path, out: Path | None, ply: Path | None) -> None:
    """Write a recording anew with corrected depth, its point clouds, or both.

    The rows, the camera and the amplitude stay as they are; depth is NaN where there was no
    return. The mask keeps the pixels whose distance and amplitude lie in the calibrated range.
    Raw samples are left out: they would disagree with the corrected depth. Point clouds are in the
    camera's frame, metres: x right, y down, z forward.
    """
    from tofcorr.correction.corrector_file import load_corrector
    from tofcorr.data.recording import Recording

    if out is None and ply is None:
        raise click.UsageError("Nothing to write: give --out, --ply, or both.")
    if out == ply:
        raise click.UsageError("--out and --ply name the same folder; choose another for one.")
    # Contents are checked as the frames pass by; the recording may be larger than memory.
    recording = Recording.open(recording_path, check_contents=False)
    corrector, metadata = load_corrector(model)
    _refuse_another_camera(metadata, recording, model)
    if out is not None:
        _write_recording(corrector, recording, model, out)
    if ply is not None:
        _write_point_clouds(corrector, recording, model, ply)


def _write_recording(
    corrector: "ScriptModule", recording: "Recording", model: Path, out: Path
) -> None:
    from tofcorr.data.corrected import write_corrected

    with _progress(recording, model) as advance:
        share = write_corrected(corrector, recording, out, progress=advance)
    if recording.raw is not None:
        click.echo("raw.npy was left out: it would disagree with the corrected depth.", err=True)
    click.echo(
        f"{out}: {recording.num_frames} frames corrected; {share:.1%} of the pixels with a return "
        "lie in the calibrated range."
    )


def _write_point_clouds(
    corrector: "ScriptModule", recording: "Recording", model: Path, ply: Path
) -> None:
    from tofcorr.data.corrected import write_point_clouds

    with _progress(recording, model) as advance:
        write_point_clouds(corrector, recording, ply, progress=advance)
    click.echo(f"{ply}: point clouds of {recording.num_frames} frames, before and after.")


@contextmanager
def _progress(recording: "Recording", model: Path) -> Iterator[Callable[[int], object]]:
    """Show progress over the frames; turn the corrector's own refusals into one sentence."""
    import torch

    with bar(recording.num_frames, "correcting") as advance:
        try:
            yield advance
        except (RuntimeError, torch.jit.Error) as error:
            raise CalibrationDataError(f"{model}: {_last_line(error)}") from None


def _refuse_another_camera(
    metadata: "CorrectorMetadata", recording: "Recording", model: Path
) -> None:
    """Refuse a recording that the corrector was not made for."""
    if metadata.depth_kind not in (recording.depth_kind, None):
        raise CalibrationDataError(
            f"{recording.path}: depth is of kind '{recording.depth_kind}', but {model} corrects "
            f"'{metadata.depth_kind}'. Train on a recording of this camera and driver."
        )
    camera, made_for = recording.camera, metadata.camera
    size = (made_for.width or camera.width, made_for.height or camera.height)
    if size != (camera.width, camera.height):
        raise CalibrationDataError(
            f"{recording.path}: frames are {camera.width}x{camera.height} pixels, but {model} "
            f"was made for {size[0]}x{size[1]}."
        )
    lens = (made_for.K, made_for.distortion)
    if lens not in ((camera.matrix, camera.distortion), (None, None)):
        click.echo(
            f"Warning: {recording.path} has another lens calibration than {model} was made with; "
            "the correction holds only if the camera and its lens are the same.",
            err=True,
        )
    if metadata.needs_amplitude:
        recording.require("amplitude", f"the corrector {model}")


def _last_line(error: Exception) -> str:
    """Return the message that TorchScript puts behind its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    kind, colon, message = (lines[-1] if lines else type(error).__name__).partition(": ")
    named = colon and kind.replace(".", "_").isidentifier()  # Such as builtins.ValueError.
    return message if named else kind + colon + message
