"""`tofcorr simulate`: draw a recording from the sensor simulator."""

from pathlib import Path

import click

from tofcorr.cli.shared_options import config_options
from tofcorr.files.arguments import NewPath


@click.command()
@config_options("simulate", "Camera, scene and robot", "robot.tilt_deg=20")
@click.option(
    "--out",
    required=True,
    type=NewPath(),
    help="Folder of the recording, made anew.",
)
@click.option("--seed", type=click.IntRange(min=0), help="Instead of the seed in the file.")
@click.option("--frames", type=click.IntRange(min=1), help="Take only so many frames.")
def command(
    config: str, changes: tuple[str, ...], out: Path, seed: int | None, frames: int | None
) -> None:
    """Simulate a camera on a robot before a wall, and write what it records.

    What the camera cannot know (true distances, the hand-eye transform) goes to OUT/truth, which
    nothing that fits, corrects or diagnoses reads.
    """
    from tofcorr.options import resolve_options
    from tofcorr.progress import through
    from tofcorr.simulation.options import SimulatorOptions
    from tofcorr.simulation.simulator import simulate

    options = resolve_options(SimulatorOptions, config, changes)
    if seed is not None:
        options = options.model_copy(update={"seed": seed})
    simulate(
        options,
        out,
        num_frames=frames,
        progress=lambda states, total: through(states, "simulating", total=total),
    )
    click.echo(f"Recording written to {out}")
