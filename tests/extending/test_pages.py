"""The pages on adding a term, an effect, an importer and a format: their examples are built in.

Each page's file goes into a copy of the package, its line into the registry, and every other Python
block runs there. Nothing else of the package is touched.
"""

from pathlib import Path

import pytest
from docs.pages import title
from extending.extension import Extension
from extending.page_examples import PAGES


def test_the_copy_is_what_runs(extension: Extension) -> None:
    assert extension.printed_by("whose").strip() == str(extension.root)


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_example_takes_one_file_and_one_line(page: Path, extension: Extension) -> None:
    extension.printed_by(page.stem)
