"""`tofcorr degrade`: an ideal depth camera's frames, as the real camera would give them."""

from pathlib import Path
from typing import Literal

import click

from tofcorr.files.arguments import NewPath


@click.command()
@click.option(
    "--sensor",
    required=True,
    help="The camera: a shipped name such as kinect_v2, or the report of a diagnosis, or its "
    "sensor.yaml.",
)
@click.option(
    "--recording",
    "recording_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of the ideal recording, rendered with the camera's intrinsics.",
)
@click.option(
    "--out",
    required=True,
    type=NewPath(),
    help="Folder of the degraded recording, made anew.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all random draws."
)
@click.option(
    "--amplitude-is",
    type=click.Choice(["amplitude", "reflectivity"]),
    default="amplitude",
    show_default=True,
    help="What amplitude.npy of the ideal recording holds: the camera's units, or a share 0 to 1.",
)
def command(
    sensor: str,
    recording_path: Path,
    out: Path,
    seed: int,
    amplitude_is: Literal["amplitude", "reflectivity"],
) -> None:
    """Write what a real camera would have measured where an ideal one recorded.

    Depth gets the camera's error terms, effects, noise and missing pixels. Poses, planes and all
    columns stay; true_depth.npy keeps the ideal depth. Effects that no depth image can show are
    left out and listed.
    """
    import warnings

    from tofcorr.data.recording import Recording
    from tofcorr.progress import bar
    from tofcorr.sensor.degrade import degrade

    recording = Recording.open(recording_path, check_contents=False)
    with (
        warnings.catch_warnings(record=True) as caught,
        bar(recording.num_frames, "degrading") as advance,
    ):
        warnings.simplefilter("always")
        done = degrade(
            sensor, recording, out, seed=seed, amplitude_is=amplitude_is, progress=advance
        )
    for sentence in dict.fromkeys(str(warning.message) for warning in caught):
        click.echo(f"Warning: {sentence}", err=True)
    click.echo(
        f"{out}: {done.recording.num_frames} frames; {done.valid_share:.1%} of the pixels with a "
        "true distance are valid."
    )
