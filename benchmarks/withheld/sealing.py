"""Answers kept apart from recordings, and the hashes that show they were not touched in between."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class BrokenSealError(Exception):
    """An answer is missing or is not the one that was sealed."""


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def seal(folder: Path, answer: dict[str, Any], arrays: dict[str, NDArray[np.float32]]) -> str:
    """Write an answer and its arrays; return the hash that commits to all of them."""
    folder.mkdir(parents=True)
    hashes = {}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
        hashes[name] = digest((folder / f"{name}.npy").read_bytes())
    text = json.dumps(answer | {"arrays": hashes}, indent=1, sort_keys=True)
    (folder / "answer.json").write_text(text)
    return digest(text.encode())


def unseal(folder: Path, expected: str) -> dict[str, Any]:
    """Read an answer after checking it and its arrays against the hash.

    Raises:
        BrokenSealError: naming the file that is missing or differs.
    """
    try:
        text = (folder / "answer.json").read_bytes()
    except FileNotFoundError:
        raise BrokenSealError(f"{folder / 'answer.json'} is missing") from None
    if digest(text) != expected:
        raise BrokenSealError(f"{folder / 'answer.json'} is not the answer that was sealed")
    answer = json.loads(text)
    for name, value in answer["arrays"].items():
        file = folder / f"{name}.npy"
        if not file.exists() or digest(file.read_bytes()) != value:
            raise BrokenSealError(f"{file} is missing or is not the array that was sealed")
    return answer
