"""Every registered format of export keeps its side of the registry."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tofcorr.correction.export.registry import FORMATS, Format, format_named
from tofcorr.errors import ConfigError


@pytest.mark.parametrize("name", FORMATS)
def test_a_registered_format_has_a_writer_an_ending_and_a_summary(name: str) -> None:
    found = format_named(name)
    writer = import_module(f"tofcorr.correction.export.{name}")
    assert callable(getattr(writer, f"export_{name}"))
    assert found.ending.startswith(".")
    assert found.summary


def test_an_unknown_format_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'tflite' is no format of export\. Known: torchscript"):
        format_named("tflite")


def test_a_format_without_its_packages_says_how_to_install_them() -> None:
    missing = Format("onnx", ".onnx", "", packages=("no_such_package",), extra="onnx")
    with pytest.raises(ConfigError, match=r"no_such_package: pip install 'tofcorr\[onnx\]'"):
        missing.require_packages()


def test_the_registry_loads_without_torch() -> None:
    code = "import sys, tofcorr.correction.export.registry; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
