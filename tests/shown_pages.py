"""Pages in a browser and as text: what is cut, what is silent, and what they would fetch."""

import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from optional import present

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="needs a Chromium: Debian's package is `chromium`"
)
WIDTHS = (1200, 480)
LOOK = (Path(__file__).parent / "look.js").read_text(encoding="utf-8")


def looked_at(page: str, folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Open a page in frames of all widths; return what each shows, and what the console said."""
    source = html.escape(page)
    frames = [f'<iframe width={width} height=2000 srcdoc="{source}"></iframe>' for width in WIDTHS]
    around = folder / "around.html"
    style = "<style>iframe { border: 0; display: block; }</style>"
    around.write_text(f"<!DOCTYPE html>{style}{''.join(frames)}<script>{LOOK}</script>")
    done = subprocess.run(
        [
            present(CHROMIUM),
            *("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
            *("--enable-logging=stderr", "--v=0", f"--user-data-dir={folder / 'profile'}"),
            *("--window-size=1300,4100", "--virtual-time-budget=20000", "--dump-dom"),
            around.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found = re.search(r"seen (\[.*\]) end", html.unescape(done.stdout), re.DOTALL)
    assert found, f"the page did not load: {done.stdout[:300]}"
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(found.group(1)), "\n".join(console)


class _Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def fetched(page: str) -> list[str]:
    """Everything that a browser would have to fetch to show a page."""
    named = [own for _, tag in _Tags(page).found for key in _ADDRESSES if (own := tag.get(key))]
    named += re.findall(r"url\((.*?)\)", page) + re.findall(r"@import.*|fetch\(.*|import\(.*", page)
    return [own for own in named if not own.strip("'\"").startswith(("#", "data:"))]


_ADDRESSES = ("src", "href", "xlink:href", "srcset", "data", "action", "poster")


def silent(page: str) -> int:
    """How many pictures have no words for those who cannot see them."""
    tags = _Tags(page).found
    pictures = sum(tag in ("svg", "canvas", "img") for tag, _ in tags)
    named = sum(own.get("role") == "img" and bool(own.get("aria-label")) for _, own in tags)
    return pictures - named
