"""The examples of the pages on adding a term, an effect, an importer, a format and a check.

Each page shows a file, a line of a registry, and Python that uses them.
"""

from pathlib import Path

from docs.pages import ROOT, Block, blocks
from extended_package import Addition

PAGES = sorted((ROOT / "docs" / "how-to").glob("add-*.md"))
# The text in each registry in front of which the line goes.
END_OF_LIST = {
    "error_terms": ")\n\n\ndef _class",
    "simulation": ")\n\n\ndef _effect",
    "importing": '}\n"""The line of each',
    "correction": ")\n\nFORMATS",
    "plausibility": ')\n"""Checks that look at values',
}

# The folder of the package that was imported.
WHOSE = "from pathlib import Path; import tofcorr; print(Path(tofcorr.__file__).parents[1])"
# What the pages say of the command line.
IMPORT_HELP = (
    "from tofcorr.cli.main import group; group(['import', '--help'], standalone_mode=False)"
)
EXPORT_RUN = """
from pathlib import Path

import tofcorr
from tofcorr.cli.main import group
from tofcorr.correction.state import save_calibration

camera = tofcorr.CameraIntrinsics(
    width=7, height=5, matrix=((9.0, 0.0, 3.0), (0.0, 9.0, 2.0), (0.0, 0.0, 1.0))
)
module = tofcorr.DepthCorrection(camera, [{"kind": "distance_polynomial", "degree": 2}])
module.export("ros_command", "module.sh")
Path("run").mkdir()
save_calibration("run/state.pt", module.to_state())
words = "export --run run --format ros_command --out command.sh"
group(words.split(), standalone_mode=False)
group(["export", "--help"], standalone_mode=False)
"""


def addition_of(page: Path) -> Addition:
    """Return the file and the line that a page shows."""
    new, line = (block for block in _python(page) if _path(block))
    registry = str(_path(line))
    return Addition(
        path=str(_path(new)),
        text=new.text,
        registry=registry,
        before=END_OF_LIST[registry.partition("/")[0]],
        line=line.text.splitlines()[1],
    )


def use_of(page: Path) -> str:
    """Return the Python of a page that uses what it adds."""
    rest = [block.text for block in _python(page) if not _path(block)]
    assert rest, "the page shows no use"
    return "\n".join(rest)


def _python(page: Path) -> list[Block]:
    return [block for block in blocks(page) if block.language == "python"]


def _path(block: Block) -> str | None:
    """Return the file that a block is part of, named by its first line."""
    first = block.text.splitlines()[0]
    return first.removeprefix("# tofcorr/") if first.startswith("# tofcorr/") else None
