"""A copy of the package with two effects, two terms, an importer and a format more."""

import pytest
from extended_package import ExtendedPackage
from extending import page_examples, root_term, stripes
from extending.extension import Extension
from extending.page_examples import PAGES, addition_of, use_of


@pytest.fixture(scope="session")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Extension:
    """The copy, and what ran in it: one process for all, which loads torch once."""
    package = ExtendedPackage.copy(tmp_path_factory.mktemp("extended"))
    for addition in (*map(addition_of, PAGES), stripes.STRIPES, root_term.ROOT_TERM):
        package.add(addition)
    pieces = {page.stem: use_of(page) for page in PAGES}
    pieces |= {"import_help": page_examples.IMPORT_HELP, "ros_command": page_examples.EXPORT_RUN}
    pieces |= {"whose": page_examples.WHOSE, "stripes": stripes.RUN, "root": root_term.RUN}
    return Extension(package.root, package.run(pieces))
