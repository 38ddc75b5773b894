"""A page: one HTML file that needs nothing else, in the same dress for every command.

A template extends `page.html.j2` and fills its blocks `title` and `content`; what stands on many
pages, a picture with its words above all, is a macro of `parts.html.j2`.
"""

import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import DictLoader, Environment, StrictUndefined
from markupsafe import Markup, escape

from tofcorr.errors import CalibrationDataError
from tofcorr.files import refuse_existing
from tofcorr.version import __version__

if TYPE_CHECKING:  # Matplotlib takes longer to import than a short fit.
    from matplotlib.figure import Figure


def page_text(
    folder: str,
    name: str,
    figures: Mapping[str, "Figure"],
    filters: Mapping[str, Callable[..., Any]],
    **values: object,
) -> str:
    """Return a page, made by the template of this name in a package.

    Args:
        folder: The package.
        name: File name of the template, which extends `page.html.j2`.
        figures: Its figures, which it reads as `figures`.
        filters: What it calls.
        values: What else it reads; the program's `version` and the `style` are given.
    """
    from tofcorr.pages.drawing import svg_of

    sources = {one: resource("tofcorr.pages", one) for one in ("page.html.j2", "parts.html.j2")}
    environment = Environment(
        loader=DictLoader(sources | {name: resource(folder, name)}),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters, code=_code)
    return environment.get_template(name).render(
        values,
        figures={key: Markup(svg_of(figure)) for key, figure in figures.items()},
        style=Markup(resource("tofcorr.pages", "style.css")),
        version=__version__,
    )


def _code(text: str) -> Markup:
    """Return text as HTML, with what stands between backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", escape(text)))


def resource(folder: str, name: str) -> str:
    """Return the text of a file of a package."""
    return files(folder).joinpath(name).read_text(encoding="utf-8")


def refuse_page(path: Path) -> None:
    """Raise CalibrationDataError unless a page can be written here: a new name in .html."""
    if path.suffix.lower() not in (".html", ".htm"):
        said = "a page is one file; expected a name that ends in .html"
        raise CalibrationDataError(f"{path}: {said}")
    refuse_existing(path)
