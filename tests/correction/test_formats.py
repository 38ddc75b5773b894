"""Every registered format of export keeps its side of the registry."""

from importlib import import_module

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


def test_an_unknown_format_and_one_without_its_packages_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"'tflite' is no format of export\. Known: torchscript"):
        format_named("tflite")
    missing = Format("onnx", ".onnx", "", packages=("no_such_package",), extra="onnx")
    with pytest.raises(ConfigError, match=r"no_such_package: pip install 'tofcorr\[onnx\]'"):
        missing.require_packages()
