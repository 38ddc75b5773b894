"""The files of cv::FileStorage, read without OpenCV: its parser ends the program on some texts."""

import re
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.options.messages import one_line
from tofcorr.options.yaml_files import parse_yaml

_FIRST_LINE = re.compile(r"\A%YAML[: ][^\n]*")
_TAG = re.compile(r"!!opencv-[a-z-]+")


def is_file_storage(text: str) -> bool:
    """Whether a text looks as OpenCV writes it: XML, YAML with its tags, or JSON with its types."""
    return "opencv-matrix" in text or text.startswith("%YAML:") or text.lstrip().startswith("<")


def read_file_storage(text: str, source: str) -> dict[str, Any]:
    """Return the keys and values of a text; a matrix as its `rows`, `cols` and `data`.

    Args:
        text: YAML, XML or JSON.
        source: Where it comes from, for messages.

    Raises:
        CalibrationDataError: It is none of them, or a matrix has another number of entries than
            rows and columns.
    """
    try:
        values = _xml(text) if text.lstrip().startswith("<") else _yaml(text, source)
    except (ConfigError, ElementTree.ParseError, ValueError) as error:
        reason = one_line(str(error).removeprefix(f"{source}: "))
        raise CalibrationDataError(f"{source}: not a readable OpenCV file ({reason}).") from None
    for key, value in values.items():
        if isinstance(value, Mapping) and "data" in value:
            _check_matrix(value, f"{source}: '{key}'")
    return values


def _yaml(text: str, source: str) -> dict[str, Any]:
    """Read YAML and JSON, which is YAML too; OpenCV's first line and tags are not."""
    values = parse_yaml(_TAG.sub("", _FIRST_LINE.sub("", text, count=1)), source)
    if not isinstance(values, Mapping):
        raise ConfigError(f"expected keys and values, got {type(values).__name__}")
    return dict(values)


def _xml(text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise ValueError("it declares entities or a document type, which OpenCV's files never do")
    return {one.tag: _element(one) for one in ElementTree.fromstring(text)}


def _element(element: ElementTree.Element) -> Any:  # noqa: ANN401 - text, number or matrix
    parts = {one.tag: (one.text or "").strip() for one in element}
    if "data" in parts:
        return parts | {"data": parts["data"].split()}
    return (element.text or "").strip().strip('"')


def _check_matrix(value: Mapping[str, Any], where: str) -> None:
    data, size = value["data"], [value.get("rows"), value.get("cols")]
    try:
        rows, columns = (int(str(one)) for one in size)
    except ValueError:
        rows, columns = -1, -1
    if not isinstance(data, list) or len(data) != rows * columns:
        count = len(data) if isinstance(data, list) else "no list"
        raise CalibrationDataError(
            f"{where} must have rows x cols numbers, got {count} for "
            f"{one_line(str(size[0]))} x {one_line(str(size[1]))}."
        )
