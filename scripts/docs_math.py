"""Turn the equations of the documents into MathML while mkdocs builds them.

Pages write `$x$` and `$$x$$`, docstrings write Sphinx's `:math:` and `.. math::`. Browsers draw
MathML themselves, so that a page needs neither a script nor a font from elsewhere.
"""

import html
import re
from typing import Any

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor

# What pymdownx.arithmatex leaves behind: TeX between \( and \), or between \[ and \].
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
_ROLE = re.compile(r":math:`([^`]+)`")
_DIRECTIVE = re.compile(r"^(\s*)\.\. math::\s*(.*)$")


class _SphinxMath(Preprocessor):
    """Rewrites Sphinx's two ways to write an equation into `$` and `$$`."""

    def run(self, lines: list[str]) -> list[str]:
        done: list[str] = []
        body: list[str] | None = None
        indent, in_code = 0, False
        for line in lines:
            in_code ^= line.lstrip().startswith("```")
            start = None if in_code else _DIRECTIVE.match(line)
            if start:
                body, indent = [start[2]], len(start[1])
                continue
            if body is not None:
                inside = not line.strip() or len(line) - len(line.lstrip()) > indent
                if inside and not (not line.strip() and any(body)):
                    body.append(line.strip())
                    continue
                done += _display(body, indent)
                body = None
            done.append(line if in_code else _ROLE.sub(r"$\1$", line))
        return done if body is None else done + _display(body, indent)


def _display(body: list[str], indent: int) -> list[str]:
    return ["", " " * indent + "$$" + " ".join(body).strip() + "$$", ""]


class _SphinxMathExtension(Extension):
    """Registers the rewriting with Python-Markdown."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 - Python-Markdown's name
        # Before fenced code and equations are looked for, which happens from 30 downwards.
        md.preprocessors.register(_SphinxMath(md), "sphinx_math", 40)


def on_config(config: Any) -> Any:  # noqa: ANN401 - mkdocs' own mapping
    """Add the rewriting to the Markdown of pages and docstrings."""
    config["markdown_extensions"].append(_SphinxMathExtension())
    return config


def on_post_page(output: str, **_: object) -> str:
    """Replace TeX by MathML in a page that is ready, and keep a number and its ± on one line."""
    output = output.replace(" ± ", "\u00a0±\u00a0")
    # The box around an equation scrolls where a screen is narrower than the equation.
    output = _DISPLAY.sub(
        lambda found: f'<div class="equation">{_mathml(found[1], "block")}</div>', output
    )
    return _INLINE.sub(lambda found: _mathml(found[1], "inline"), output)


def _mathml(tex: str, display: str) -> str:
    return convert(html.unescape(tex).strip(), display=display)
