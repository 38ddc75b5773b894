"""The documents as a site: it builds without a warning, and what it shows is up to date."""

import re
import sys
from inspect import isclass
from pathlib import Path

import pytest
from docs.pages import PAGES, ROOT, title
from running import printed

import tofcorr
from tofcorr.error_terms.base import DescribedModule

# A link of Markdown, or the address of an image: [words](target) and ![words](target).
_LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> str:
    """All pages of the site, built without a warning."""
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("site")
    printed(sys.executable, "-m", "sphinx", "-q", "-W", "docs", folder, cwd=ROOT)
    pages = [path.read_text(encoding="utf-8") for path in folder.rglob("*.html")]
    assert len(pages) > 20
    return "".join(pages)


def test_site_needs_nothing_from_elsewhere(site: str) -> None:
    """Links, anchors, pages that nothing points to and names of the API are checked by building."""
    assert "<math" in site
    # MyST marks every page as none of MathJax's.
    assert "mathjax" not in site.lower().replace("mathjax_ignore", ""), "an equation is still TeX"
    assert "fonts.googleapis" not in site
    assert "cdn." not in site


def test_search_reads_no_file_of_its_own_accord(site: str) -> None:
    """A browser that opens the site from a folder runs a script there, and may fetch nothing."""
    assert '<script src="searchindex.js"' in site


@pytest.mark.parametrize("name", [n for n in tofcorr.__all__ if isclass(getattr(tofcorr, n))])
def test_site_shows_every_public_method_of_a_public_class(site: str, name: str) -> None:
    """The methods of DepthCorrection that correct a frame are inherited, and were not shown."""
    public = getattr(tofcorr, name)
    where = f"{public.__module__}.{public.__qualname__}"
    own = {
        method
        for one in public.__mro__
        # What a state is made of is torch's concern, not the user's.
        if one.__module__.startswith("tofcorr.") and one is not DescribedModule
        for method, value in vars(one).items()
        if (callable(value) or isinstance(value, property | classmethod))
        and not method.startswith("_")
        and not method.endswith(("_extra_state", "extra_repr"))
    }
    assert [one for one in sorted(own) if f'id="{where}.{one}"' not in site] == []
    assert f'id="{where}"' in site


@pytest.mark.parametrize("page", [p for p in PAGES if p.parent == ROOT], ids=title)
def test_links_outside_the_site_resolve(page: Path) -> None:
    """The site sees only docs/: README and CONTRIBUTING are looked at here."""
    links = _LINK.findall(page.read_text(encoding="utf-8"))
    local = [(target, anchor) for target, anchor in links if "://" not in target]
    assert local
    for target, anchor in local:
        assert (page.parent / target).exists(), target
        if anchor:
            lines = (page.parent / target).read_text(encoding="utf-8").splitlines()
            slugs = {_slug(line) for line in lines if line.startswith("#")}
            assert anchor.removeprefix("#") in slugs, (target, anchor)


def test_every_public_name_has_its_place_in_the_api() -> None:
    index = (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`(\w+)`", index))
    assert set(tofcorr.__all__) - {"__version__"} <= listed


def _slug(heading: str) -> str:
    words = re.sub(r"[^\w\s-]", "", heading.lstrip("#").strip().lower())
    return re.sub(r"\s+", "-", words)
