"""What the package says of itself: dependencies, licence, version, public names."""

import ast
import json
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any

import pytest
import yaml
from import_graph import imported
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import tofcorr

ROOT = Path(__file__).resolve().parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
FOR_DEVELOPERS = ("bench", "renewed", "fuzz", "docs", "test")


def requirements(*not_of: str) -> list[Requirement]:
    """Return what is declared, but for some extras."""
    extras = [one for name, extra in EXTRAS.items() if name not in not_of for one in extra]
    return [*map(Requirement, [*PROJECT["dependencies"], *extras])]


DECLARED = requirements()


def sources(folder: Path) -> Iterator[str]:
    """Yield the Python files below `folder`, and the code of its notebooks."""
    for path in folder.rglob("*.py"):
        yield path.read_text(encoding="utf-8")
    for path in folder.rglob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        yield from ("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def imported_packages(folder: Path) -> set[str]:
    """Return the top-level packages imported below `folder`, inside functions too."""
    names = {name.partition(".")[0] for source in sources(folder) for name in imported(source)}
    return names - set(sys.stdlib_module_names)


@pytest.mark.parametrize(
    ("folder", "not_of"),
    [
        ("tofcorr", FOR_DEVELOPERS),
        *((folder, ()) for folder in ("benchmarks", "tests", "scripts", "docs")),
    ],
)
def test_every_imported_package_is_declared(folder: str, not_of: tuple[str, ...]) -> None:
    declared = {canonicalize_name(one.name) for one in requirements(*not_of)}
    own = {path.stem for path in (ROOT / "tests").iterdir()}
    own |= {"tofcorr", "benchmarks", "tests", "scripts"}
    own |= {path.parent.name for path in (ROOT / "examples").rglob("__init__.py")}
    distributions = packages_distributions()
    undeclared = {
        name
        for name in imported_packages(ROOT / folder) - own
        if not declared & {canonicalize_name(one) for one in distributions.get(name, [name])}
    }
    assert undeclared == set()


# Named exactly in pyproject.toml and installed by hand: a renderer of 100 MB, a fuzzer for Linux.
BY_HAND = [*map(Requirement, (*EXTRAS["renewed"], *EXTRAS["fuzz"]))]


def pinned() -> dict[str, str]:
    """Return the versions that the scripts install, by the packages' names."""
    lines = (ROOT / "scripts" / "requirements.in").read_text("utf-8").splitlines()
    return {
        canonicalize_name(one.name): next(iter(one.specifier)).version
        for one in map(Requirement, (line for line in lines if line and line[0] != "#"))
    }


def test_all_that_is_pinned_has_a_hash_but_torch() -> None:
    text = (ROOT / "scripts" / "requirements.txt").read_text("utf-8")
    entries = re.findall(r"^(\S+)==(\S+)((?:.*\\\n)+ +--hash=sha256:\w+)$", text, re.MULTILINE)
    hashed = {canonicalize_name(name): version.rstrip(";") for name, version, _ in entries}
    assert hashed == {name: version for name, version in pinned().items() if name != "torch"}


@pytest.mark.parametrize(
    "requirement", [one for one in DECLARED if one not in BY_HAND], ids=lambda one: one.name
)
def test_every_dependency_has_a_lower_bound_and_a_pinned_version_above_it(
    requirement: Requirement,
) -> None:
    assert {one.operator for one in requirement.specifier} <= {">=", "=="}
    assert requirement.specifier
    assert requirement.specifier.contains(pinned()[canonicalize_name(requirement.name)])


def needs(requirement: Requirement) -> list[Requirement]:
    """Return what an installed package needs on this machine; nothing if it is not installed."""
    try:
        listed = [Requirement(one) for one in requires(requirement.name) or []]
    except PackageNotFoundError:
        return []
    extras = [{"extra": extra} for extra in (*requirement.extras, "")]
    return [one for one in listed if one.marker is None or any(map(one.marker.evaluate, extras))]


def test_what_a_pinned_package_needs_is_pinned_too() -> None:
    """The scripts install what is pinned and resolve nothing. torch alone may be for CUDA."""
    found: dict[str, str] = {}
    waiting = [(one, "pyproject.toml") for one in DECLARED if one not in BY_HAND]
    while waiting:
        one, needed_by = waiting.pop()
        if str(one) not in found and needed_by != "torch":
            found[str(one)] = needed_by
            waiting += [(other, one.name) for other in needs(one)]
    names = {canonicalize_name(Requirement(one).name): by for one, by in found.items()}
    assert {name: by for name, by in names.items() if name not in pinned()} == {}


def test_version_licence_and_authors_agree_wherever_they_stand() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    licence = (ROOT / "LICENSE").read_text("utf-8")
    assert PROJECT["version"] == tofcorr.__version__ == citation["version"]
    assert f"\n## [{tofcorr.__version__}] - {citation['date-released']}\n" in changelog
    assert "\n## [Unreleased]\n" in changelog
    assert PROJECT["license"] == citation["license"] == "Apache-2.0"
    assert "Apache License\n                           Version 2.0, January 2004" in licence
    assert "END OF TERMS AND CONDITIONS" in licence
    assert PROJECT["authors"] == citation["authors"]


def test_the_lazy_names_are_those_that_type_checkers_see() -> None:
    tree = ast.parse((ROOT / "tofcorr" / "__init__.pyi").read_text("utf-8"))
    seen = {
        alias.asname: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    }
    assert set(seen) == set(tofcorr.__all__)
    for name, module in seen.items():
        assert getattr(tofcorr, name) is getattr(sys.modules[str(module)], name)
    with pytest.raises(AttributeError, match="module 'tofcorr' has no attribute 'Recordings'"):
        vars(tofcorr)["__getattr__"]("Recordings")
