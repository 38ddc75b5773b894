"""What the coordinate frames of a recording are called."""

from typing import Annotated

from pydantic import AfterValidator, Field

from tofcorr.options import Options


def _printable(name: str) -> str:
    if not name.isprintable() or name != name.strip():
        raise ValueError("a frame's name is one line of text without spaces around it")
    return name


FrameName = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]


class FrameNames(Options):
    """What the robot calls its coordinate frames; for reports and exports.

    Attributes:
        world: The frame of the planes: the robot's base, or, for a camera that stands still, the
            tool that carries the target.
        tool: The frame that carries the camera: the tool, or, for a camera that stands still, the
            base.
        camera: The camera's optical frame.
        eye_to_hand: Whether the camera stands still and the robot carries the target.
    """

    world: FrameName = "world"
    tool: FrameName = "tool"
    camera: FrameName = "camera"
    eye_to_hand: bool = False
