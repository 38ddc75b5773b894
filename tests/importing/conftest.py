"""Recorded once for all tests of the doors, and searched for walls once."""

from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

import pytest
import torch
from importing.frames.imported import Imported, import_png
from importing.posed_scene import Drive, Recorded

from tofcorr.importing import posed, robot_images

SMALL = Drive(stops=20, width=32, height=24, rate=5.0)
FULL = Drive(width=48, height=36)
"""40 stops, and the moves between them, at some 7 images a second."""


@pytest.fixture(
    scope="session",
    params=[pytest.param(SMALL, id="small"), pytest.param(FULL, id="full", marks=pytest.mark.slow)],
)
def drive(request: pytest.FixtureRequest) -> Recorded:
    """Stops, and the moves between them: a few for every run, all of them for the slow one."""
    return request.param.record()


@pytest.fixture(scope="session")
def at_stops(drive: Recorded) -> Recorded:
    """One image of each stop."""
    return drive.one_a_stop()


@pytest.fixture(scope="session")
def from_files(at_stops: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Imported:
    """The images of the stops and the poses, imported from PNG and TUM files."""
    return import_png(at_stops, tmp_path_factory.mktemp("from_files"))


@pytest.fixture(scope="session", autouse=True)
def one_search_for_equal_images() -> Iterator[None]:
    """Some fifty imports of one drive: equal images have equal planes, and those equal walls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_images, "planes_of_image", _once(robot_images.planes_of_image))
        patch.setattr(posed, "walls_of_planes", _once(posed.walls_of_planes))
        yield


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that is called once for equal arguments."""
    found: dict[bytes, Any] = {}

    def call(*values: Any, **named: Any) -> Any:
        content = BytesIO()
        # The folder that images come from is in messages only.
        torch.save((values, {key: one for key, one in named.items() if key != "origin"}), content)
        key = content.getvalue()
        if key not in found:
            found[key] = function(*values, **named)
        return found[key]

    return call
