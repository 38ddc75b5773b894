"""Depth and amplitude images of any source: what an importer of posed images takes."""

import re
from pathlib import Path

import numpy as np
import pytest
from cameras import camera
from optional import present

from tofcorr.importing.images import DepthCoding, DepthImage, coded_image, of_size, read_array
from tofcorr.importing.run import RefusedViewError

CAMERA = camera((4, 3), (5.0, 5.0), (1.5, 1.0))
FITS, TURNED = np.ones((3, 4), np.float32), np.ones((4, 3), np.float32)


def test_an_image_of_another_size_than_the_intrinsics_is_refused_with_both_sizes() -> None:
    for image in (DepthImage(FITS), DepthImage(FITS, FITS)):
        assert of_size(image, CAMERA) is image
    for what, image in (("depth", DepthImage(TURNED)), ("amplitude", DepthImage(FITS, TURNED))):
        message = f"its {what} has 3x4 pixels, the intrinsics hold for 4x3"
        with pytest.raises(RefusedViewError, match=f"^{re.escape(message)}$"):
            of_size(image, CAMERA)


def test_amplitudes_turn_with_the_images_and_keep_their_counts() -> None:
    counts = np.arange(12, dtype=np.uint16).reshape(3, 4)
    depth = np.ones((3, 4)), "d.png"
    found = present(coded_image(DepthCoding(rotate=90), depth, (counts, "a.png")).amplitude)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.rot90(counts, -1))
    with pytest.raises(RefusedViewError, match=r"^a.png has 8 bits a pixel; .* as amplitude "):
        coded_image(DepthCoding(), depth, (counts.astype(np.uint8), "a.png"))


def _write_exr(path: Path, names: tuple[str, ...]) -> None:
    """Write an EXR file whose channels hold 1, 2, ... in the order of their names."""
    exr = pytest.importorskip("OpenEXR", reason="the extra `exr` is not installed")
    channels = {name: np.full((3, 4), 1.0 + k, np.float32) for k, name in enumerate(names)}
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, channels) as file:
        file.write(str(path))


@pytest.mark.parametrize(
    ("names", "value"),
    [
        (("V",), 1.0),
        (("anything",), 1.0),
        (("B", "G", "R"), 3.0),
        (("B", "G", "R", "Z"), 4.0),
        (("ViewLayer.Combined.A", "ViewLayer.Combined.R", "ViewLayer.Depth.Z"), 3.0),
        (("ViewLayer.Combined.A", "ViewLayer.Depth.V", "ViewLayer.Normal.Z"), 2.0),
    ],
)
def test_depth_is_the_channel_of_an_exr_file_that_is_called_so(
    names: tuple[str, ...], value: float, tmp_path: Path
) -> None:
    """Of Blender's files with several layers the first channel was taken, a colour."""
    _write_exr(tmp_path / "a.exr", names)
    np.testing.assert_array_equal(read_array(tmp_path / "a.exr"), value)


def test_layers_without_depth_are_refused_with_their_names(tmp_path: Path) -> None:
    _write_exr(tmp_path / "a.exr", ("ViewLayer.Normal.X", "ViewLayer.Normal.Z"))
    said = r"^a.exr holds channels ViewLayer.Normal.X, ViewLayer.Normal.Z; expected"
    with pytest.raises(RefusedViewError, match=said):
        read_array(tmp_path / "a.exr")
