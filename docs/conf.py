"""The site of the documents, built by Sphinx: `python -m sphinx -W docs build/site`.

The pages are plain Markdown, which the code host shows as well. What only the site needs stands
here: the order of its pages, and how an equation is drawn.
"""

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import tofcorr

project = "tofcorr"
project_copyright = "the tofcorr authors"
release = tofcorr.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["notebooks"]

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4  # Anchors of headings, as the code host writes them.

default_role = "literal"  # What `name` means in a docstring.
add_module_names = False
toc_object_entries_show_parents = "hide"
maximum_signature_line_length = 80
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style"), ("Class attributes", "params_style")]

suppress_warnings = ["ref.python"]  # Names of axes in annotations, such as "rows columns".

html_theme = "furo"
html_title = "tofcorr"
html_static_path = ["assets"]
html_css_files = ["extra.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}

ORDER = {
    "How to": "install command-line robot-and-wall two-cameras robot-errors record choose pytorch "
    "deploy check diagnose your-simulator sensor *",
    "Concepts": "conventions error-model estimation walls observability diagnosis *",
    "Results": "/results models diagnosis gap drift walls scene-light robustness speed openings",
    "Reference": "/format /glossary /architecture /thresholds /changelog",
    "API": "index module sensor functions data *",
}
"""Pages of the site below their headings, which name the folders; `*` is all that is left."""


def add_order(_: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the start page, where the code host does not show it."""
    if page == "index":
        for heading, names in ORDER.items():
            folder = heading.lower().replace(" ", "-")
            pages = "\n".join(n if n.startswith("/") else f"{folder}/{n}" for n in names.split())
            source[0] += (
                f"\n\n```{{toctree}}\n:hidden:\n:glob:\n:caption: {heading}\n\n{pages}\n```\n"
            )


def draw_inline(page: HTML5Translator, node: nodes.math) -> None:
    """Write an equation in a line as MathML, which browsers draw without a script or a font."""
    page.body.append(convert(node.astext(), display="inline"))
    raise nodes.SkipNode


def draw_block(page: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation of its own; its box scrolls where the screen is narrower."""
    page.body.append(f'<div class="equation">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register what this file adds to Sphinx."""
    app.add_html_math_renderer("mathml", (draw_inline, None), (draw_block, None))
    app.connect("source-read", add_order)
