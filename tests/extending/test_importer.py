"""A new importer is one file and one line of the registry."""

import json
from pathlib import Path

import numpy as np
from extended_package import extend

from tofcorr.data.recording import Recording

IMPORTER = '''
"""`tofcorr import arrays`: depth images from .npy files, before a wall at a known distance."""

from pathlib import Path

import click

from tofcorr.importing.command_line import print_report, progress_bar


@click.command(name="arrays")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path))
@click.option("--distance-m", required=True, type=float, help="Of the wall.")
def command(folder: Path, out: Path, distance_m: float) -> None:
    """Import depth images."""
    import numpy as np

    from tofcorr.data.table import FrameRow
    from tofcorr.data.writing import RecordingWriter
    from tofcorr.importing.engine import ImportedFrame, PreparedImport, camera_mapping, run_import
    from tofcorr.importing.given_intrinsics import intrinsics_from_numbers
    from tofcorr.importing.report import ImportedView, RefusedViewError
    from tofcorr.options import Options

    class ArrayOptions(Options):
        distance_m: float

    class Arrays:
        def __init__(self) -> None:
            self.folder, self.options = folder, ArrayOptions(distance_m=distance_m)

        def prepare(self, sieve):
            paths = sieve.apply(self.checked, sorted(folder.glob("*.npy")), lambda path: path.stem)
            given = intrinsics_from_numbers((50.0,), (3.5, 2.5), (), "the test")
            camera = given.camera((8, 6))
            return PreparedImport(
                views=[ImportedView(frame=i, view=p.stem) for i, p in enumerate(paths)],
                frame=lambda index: self.frame(index, paths[index]),
                open_writer=lambda path: RecordingWriter(path, camera=camera, depth_kind="z"),
                camera=camera_mapping(camera, given.source),
            )

        def checked(self, path):
            if np.load(path).shape != (6, 8):
                raise RefusedViewError(f"{path.name} has another size")
            return path

        def frame(self, index, path):
            row = FrameRow(timestamp=float(index), world_from_tool=np.eye(4), target="white",
                           normal_world=np.array([0.0, 0.0, -1.0]), offset=distance_m)
            return ImportedFrame(row=row, depth=np.load(path))

    print_report(run_import(Arrays(), out, progress_bar), out)
'''

RUN = """
import sys
from tofcorr.cli.main import main
sys.argv = ["tofcorr", "import", *{arguments!r}]
main()
"""


def test_a_new_importer_is_a_sub_command_with_report_and_refusals(tmp_path: Path) -> None:
    package = extend(
        tmp_path,
        new_file=("importing/arrays.py", IMPORTER),
        registry="importing/registry.py",
        before='    Importer("checkerboard"',
        line='    Importer("arrays", "Depth images of NumPy.", "arrays"),',
    )
    images = tmp_path / "images"
    images.mkdir()
    for name, shape in (("a", (6, 8)), ("b", (3, 3)), ("c", (6, 8))):
        np.save(images / f"{name}.npy", np.full(shape, 1.5, dtype=np.float32))

    assert "Depth images of NumPy." in package.run(RUN.format(arguments=["--help"]))
    arguments = ["arrays", str(images), "--out", str(tmp_path / "out"), "--distance-m", "1.5"]
    printed = package.run(RUN.format(arguments=arguments))

    assert printed.splitlines()[0] == f"2 of 3 views imported to {tmp_path / 'out'}"
    assert "refused b: b.npy has another size" in printed
    np.testing.assert_array_equal(Recording.open(tmp_path / "out").depth, 1.5)
    report = json.loads((tmp_path / "out/import.json").read_text(encoding="utf-8"))
    assert [view["view"] for view in report["views"]] == ["a", "c"]
    assert report["refused"] == [{"view": "b", "reason": "b.npy has another size"}]
