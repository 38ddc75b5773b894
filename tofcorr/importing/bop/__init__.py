"""Scenes in BOP's layout: depth with the camera's own poses."""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    option,
    posed_options,
    print_report,
    recording_out_option,
    take_posed_options,
)


@click.command(name="bop")
@click.argument("scene", type=click.Path(path_type=Path))
@recording_out_option
@option("--amplitude", "Names of 16-bit amplitude images, such as 'gray/*.png'; left out: none.")
@posed_options
def command(scene: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import SCENE: a folder of BOP's layout, as BlenderProc's write_bop makes it.

    It holds scene_camera.json with the camera's poses (cam_R_w2c, cam_t_w2c) and
    depth/*.png. The poses are the camera's own: the tool is the camera, and tool_from_camera the
    identity.
    """
    from tofcorr.importing.bop.scene import import_scene

    options = take_posed_options(given)
    print_report(import_scene(scene, out, options, **given), out)
