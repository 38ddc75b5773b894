"""Ways to damage a recording's files: each returns what damages a given folder."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Damage = Callable[[Path], None]


def header(**changes: Any) -> Damage:
    """Change keys of recording.yaml; keys of the camera are given as camera={...}."""

    def damage(folder: Path) -> None:
        path = folder / "recording.yaml"
        values = yaml.safe_load(path.read_text())
        camera = values["camera"] | changes.get("camera", {})
        path.write_text(yaml.safe_dump(values | changes | {"camera": camera}))

    return damage


def without_key(key: str) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "recording.yaml"
        values = yaml.safe_load(path.read_text())
        (values if key in values else values["camera"]).pop(key)
        path.write_text(yaml.safe_dump(values))

    return damage


def text(name: str, content: str | bytes) -> Damage:
    data = content.encode() if isinstance(content, str) else content

    def damage(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return damage


def cells(frame: int, **values: str) -> Damage:
    def damage(folder: Path) -> None:
        rows = _rows(folder)
        rows[frame] |= values
        _write_rows(folder, rows)

    return damage


def column_edit(edit: Callable[[list[dict[str, str]]], list[dict[str, str]]]) -> Damage:
    return lambda folder: _write_rows(folder, edit(_rows(folder)))


def array(name: str, edit: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / f"{name}.npy"
        np.save(path, edit(np.load(path)))

    return damage


def value(name: str, index: tuple[int, ...], new: float) -> Damage:
    def edit(values: np.ndarray) -> np.ndarray:
        values[index] = new
        return values

    return array(name, edit)


def removed(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def truncated(name: str) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).write_bytes((folder / name).read_bytes()[:-1])

    return damage


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _write_rows(folder: Path, rows: list[dict[str, str]]) -> None:
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def only_header(folder: Path) -> None:
    path = folder / "frames.csv"
    path.write_text(path.read_text().splitlines()[0] + "\n")


def without_column(name: str) -> Callable[[list[dict[str, str]]], list[dict[str, str]]]:
    return lambda rows: [{key: row[key] for key in row if key != name} for row in rows]
