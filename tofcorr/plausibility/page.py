"""The page of an inspection: one HTML file that needs nothing else."""

import io
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tofcorr.errors import CalibrationDataError
from tofcorr.files.staged import refuse_existing, staged_file
from tofcorr.plausibility.figures import all_figures
from tofcorr.plausibility.inspection import Inspection
from tofcorr.version import __version__

_TEMPLATE = "inspection.html.j2"


def write_page(found: Inspection, path: Path) -> None:
    """Write the page, whole or not at all.

    Raises:
        CalibrationDataError: `path` does not end in .html, exists, or cannot be written.
    """
    refuse_page(path)
    with staged_file(path, CalibrationDataError) as part:
        part.write_text(render(found), encoding="utf-8")


def refuse_page(path: Path) -> None:
    """Raise CalibrationDataError unless a page can be written here: a new name in .html."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise CalibrationDataError(
            f"{path}: the page of an inspection is one file; expected a name that ends in .html"
        )
    refuse_existing(path)


def render(found: Inspection) -> str:
    """Return the page of an inspection."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = files("tofcorr.plausibility").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    return environment.from_string(text).render(
        inspection=found,
        worst=found.findings[0].severity if found.findings else "nothing",
        figures={name: Markup(_svg(figure)) for name, figure in all_figures(found).items()},
        version=__version__,
    )


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
