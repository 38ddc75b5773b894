"""Shapes that annotations state: checked in every call of a test run, and the docstrings'."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.uncertainty import posterior_covariance
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.masks import grazing

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tofcorr"
PYTEST = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]
OPTION = "--jaxtyping-packages="
(CHECKED,) = (
    option.removeprefix(OPTION).split(",")[:-1]
    for option in PYTEST["ini_options"]["addopts"]
    if option.startswith(OPTION)
)
"""Modules and packages whose annotations the test run checks."""
SHAPE = re.compile(r"(?:Float|Int|Bool)\[Tensor, \'([^\']*)\'\]")


def is_checked(path: Path) -> bool:
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return any(module == one or module.startswith(f"{one}.") for one in CHECKED)


def annotated(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield name, annotation and docstring entry of each argument and attribute that has one."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            arguments = [*node.args.args, *node.args.kwonlyargs]
            named = {one.arg: one.annotation for one in arguments if one.annotation}
        elif isinstance(node, ast.ClassDef):
            fields = [one for one in node.body if isinstance(one, ast.AnnAssign)]
            named = {ast.unparse(one.target): one.annotation for one in fields}
            for one in node.body:  # The class docstring documents the constructor.
                if isinstance(one, ast.FunctionDef) and one.name == "__init__":
                    named |= {a.arg: a.annotation for a in one.args.args if a.annotation}
        else:
            continue
        text = " ".join((ast.get_docstring(node) or "").split())
        for name, annotation in named.items():
            entry = re.search(rf" {name}: (.*?)(?= \w+: |$)", text)
            if entry:
                yield f"{path.stem}.{node.name}.{name}", ast.unparse(annotation), entry[1]
        if isinstance(node, ast.FunctionDef) and node.returns:
            returns = text.rpartition(" Returns: ")[2].partition(" Raises: ")[0]
            result = re.split(r" Args: | Raises: ", returns)[0]
            yield f"{path.stem}.{node.name}", ast.unparse(node.returns), result


def test_a_wrong_shape_is_refused_in_a_test_run() -> None:
    normal, places = torch.zeros(2, 3), torch.zeros(2, 4, 4)
    assert plane_in_frame(normal, torch.zeros(2), places)[0].shape == (2, 3)
    for _ in range(2):  # What was refused once is refused again.
        with pytest.raises(TypeCheckError, match="offset"):
            plane_in_frame(normal, torch.zeros(3), places)
    with pytest.raises(TypeCheckError, match="offset"):
        plane_in_frame(normal, torch.zeros(2, dtype=torch.int64), places)
    with pytest.raises(TypeCheckError, match="precision"):
        posterior_covariance(torch.zeros(4, 5))
    with pytest.raises(TypeCheckError, match="tool_from_camera"):
        Parameters(torch.eye(3), torch.zeros(2))
    with pytest.raises(TypeCheckError, match="rays"):
        grazing(60.0, torch.zeros(4, 5, 2))


def test_shapes_are_annotated_only_where_they_are_checked() -> None:
    """An annotation that nobody checks is worse than none, and TorchScript cannot read one."""
    users = [p for p in PACKAGE.rglob("*.py") if "jaxtyping" in p.read_text(encoding="utf-8")]
    assert len(users) > 10
    assert [path for path in users if not is_checked(path)] == []


def axes_said(shape: str) -> list[str]:
    """Return the axes of a docstring's `(N, S + 1)` as an annotation would write them."""
    return [axis for axis in re.split(r"[, ]+", shape.replace(" + ", "+")) if axis]


def axes_annotated(shape: str) -> list[str]:
    """Return the axes of an annotation: `*batch` as `...`, `{camera.width}` as `width`."""
    return re.sub(r"\{(?:\w+\.)?(\w+)\}", r"\1", re.sub(r"\*\w+", "...", shape)).split()


def test_docstrings_and_annotations_name_the_same_axes() -> None:
    compared, different = 0, []
    for path in filter(is_checked, PACKAGE.rglob("*.py")):
        for name, annotation, text in annotated(path):
            shapes, said = SHAPE.findall(annotation), re.findall(r"[Ss]hape \(([^)]*)\)", text)
            if len(shapes) == len(said) == 1:
                compared += 1
                if axes_said(said[0]) != axes_annotated(shapes[0]):
                    different.append(f"{name}: '{shapes[0]}', and in the docstring ({said[0]})")
    assert different == []
    assert compared > 60
