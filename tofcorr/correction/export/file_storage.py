"""The YAML of cv::FileStorage, as far as a calibration needs it: text, numbers, matrices, lists."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

Value = str | int | float | np.ndarray | Sequence[Mapping[str, "Value"]]
"""What a key may hold; matrices have two dimensions and are written as double."""

_HEADER = "%YAML:1.0\n---\n"
_MATRIX_TAG = "!!opencv-matrix"
_INDENT = "   "


def file_storage_text(values: Mapping[str, Value]) -> str:
    """Return keys and values as the text of a file that cv::FileStorage opens."""
    return _HEADER + "".join(_entry(key, value, "") for key, value in values.items())


def read_matrix(path: Path, key: str) -> np.ndarray:
    """Return a matrix of a file that `file_storage_text` made; empty if there is none."""
    text = path.read_text(encoding="utf-8")
    pattern = rf"^{key}: {_MATRIX_TAG}\s+rows: (\d+)\s+cols: (\d+)\s+dt: d\s+data: \[([^\]]*)\]"
    found = re.search(pattern, text, re.MULTILINE)
    if found is None:
        return np.zeros((0, 0))
    numbers = [float(word) for word in found[3].split(",")]
    return np.array(numbers).reshape(int(found[1]), int(found[2]))


def _entry(key: str, value: Value, indent: str) -> str:
    if isinstance(value, np.ndarray):
        rows, columns = value.shape
        inner = indent + _INDENT
        lines = (", ".join(_number(number) for number in row) for row in value.tolist())
        data = f",\n{inner}{_INDENT}".join(lines)
        return (
            f"{indent}{key}: {_MATRIX_TAG}\n{inner}rows: {rows}\n{inner}cols: {columns}\n"
            f"{inner}dt: d\n{inner}data: [ {data} ]\n"
        )
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'{indent}{key}: "{escaped}"\n'
    if isinstance(value, int):
        return f"{indent}{key}: {value}\n"
    if isinstance(value, float):
        return f"{indent}{key}: {_number(value)}\n"
    inner = indent + 2 * _INDENT
    items = (
        f"{indent}{_INDENT}-\n" + "".join(_entry(name, one, inner) for name, one in item.items())
        for item in value
    )
    return f"{indent}{key}:\n" + "".join(items)


def _number(value: float) -> str:
    """Return a float with all its digits, as OpenCV reads it."""
    if math.isnan(value):
        return ".NaN"
    if math.isinf(value):
        return ".Inf" if value > 0 else "-.Inf"
    return f"{value:.16e}"
