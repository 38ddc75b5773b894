"""Shapes that annotations state: checked in every call of a test run, and the docstrings'."""

import tomllib
from pathlib import Path

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from shape_checks import checked
from torch import Tensor

from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.uncertainty import posterior_covariance
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.masks import some_pixels

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


def is_checked(path: Path) -> bool:
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return any(module == one or module.startswith(f"{one}.") for one in CHECKED)


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
    with pytest.raises(TypeCheckError, match="used"):
        some_pixels(torch.zeros(3), 1, seed=0)


def test_an_answer_is_refused_whose_arguments_were_seen_with_a_right_one() -> None:
    @checked(typechecker=beartype)
    def first(values: Float[Tensor, "n"], count: float) -> Float[Tensor, "n"]:  # noqa: F821
        return values[: int(count)]

    assert first(torch.zeros(3), 3.0).shape == (3,)
    with pytest.raises(TypeCheckError, match="return value"):
        first(torch.zeros(3), 2.0)


def test_shapes_are_annotated_only_where_they_are_checked() -> None:
    """An annotation that nobody checks is worse than none, and TorchScript cannot read one."""
    users = [p for p in PACKAGE.rglob("*.py") if "jaxtyping" in p.read_text(encoding="utf-8")]
    assert len(users) > 10
    assert [path for path in users if not is_checked(path)] == []
