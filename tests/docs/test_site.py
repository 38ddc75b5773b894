"""The documents as a site: it builds without a warning, and what it shows is up to date."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from docs.pages import PAGES, ROOT, title

import tofcorr

# A link of Markdown, or the address of an image: [words](target) and ![words](target).
_LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Links, anchors, pages that nothing points to and names of the API are all checked by it."""
    pytest.importorskip("mkdocs")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    pages = [path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")]
    assert len(pages) > 20
    assert not [page for page in pages if 'class="arithmatex"' in page], "an equation is still TeX"
    assert not [page for page in pages if "fonts.googleapis" in page or "cdn." in page]


@pytest.mark.parametrize("page", [p for p in PAGES if p.parent == ROOT], ids=title)
def test_links_outside_the_site_resolve(page: Path) -> None:
    """mkdocs sees only docs/: README and CONTRIBUTING are looked at here."""
    targets = [match[1] for match in _LINK.finditer(page.read_text(encoding="utf-8"))]
    local = [target for target in targets if "://" not in target]
    assert local
    assert [target for target in local if not (page.parent / target).exists()] == []


def test_anchors_of_the_first_page_exist() -> None:
    links = _LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    for target, anchor in links:
        if anchor:
            text = (ROOT / target).read_text(encoding="utf-8")
            slugs = {_slug(line) for line in text.splitlines() if line.startswith("#")}
            assert anchor.removeprefix("#") in slugs, (target, anchor)


def test_every_public_name_has_its_place_in_the_api() -> None:
    index = (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`(\w+)`", index))
    assert set(tofcorr.__all__) - {"__version__"} <= listed


def _slug(heading: str) -> str:
    words = re.sub(r"[^\w\s-]", "", heading.lstrip("#").strip().lower())
    return re.sub(r"\s+", "-", words)
