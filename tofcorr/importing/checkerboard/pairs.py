"""Pairs of depth and infrared images that belong together, by their names."""

import re
from dataclasses import dataclass
from pathlib import Path

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.report import Refusal

_WILDCARD = re.compile(r"(\{view\}|\*|\?)")


@dataclass(frozen=True, kw_only=True)
class ImagePair:
    """The two images of one view."""

    view: str
    depth: Path
    infrared: Path


def find_pairs(
    folder: Path, depth_pattern: str, infrared_pattern: str
) -> tuple[list[ImagePair], list[Refusal]]:
    """Pair the images whose wildcards match the same text.

    Images are never paired by their order: one missing file would shift all that follow.

    Args:
        folder: The folder that the patterns are relative to.
        depth_pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        infrared_pattern: The same for the infrared images.

    Returns:
        The pairs in natural order (2 before 10), and a refusal for each image without its partner.

    Raises:
        CalibrationDataError: There is no such folder, a pattern has no wildcard or matches
            nothing, or no two images belong together.
    """
    if not folder.is_dir():
        raise CalibrationDataError(f"{folder}: there is no such folder.")
    depth = _matches(folder, depth_pattern, "depth")
    infrared = _matches(folder, infrared_pattern, "infrared")
    shared = sorted(depth.keys() & infrared.keys(), key=_natural)
    if not shared:
        raise CalibrationDataError(
            f"{folder}: no depth image has an infrared image of the same name: '{depth_pattern}' "
            f"matches {_example(depth)}, '{infrared_pattern}' matches {_example(infrared)}. The "
            "text that {view} (or *) matches must be the same in both."
        )
    pairs = [ImagePair(view=v, depth=depth[v], infrared=infrared[v]) for v in shared]
    alone = [
        Refusal(view=v, reason=f"{path.name} has no {other} image beside it")
        for mine, other, theirs in ((depth, "infrared", infrared), (infrared, "depth", depth))
        for v, path in mine.items()
        if v not in theirs
    ]
    return pairs, sorted(alone, key=lambda refusal: _natural(refusal.view))


def _matches(folder: Path, pattern: str, what: str) -> dict[str, Path]:
    pieces = _WILDCARD.split(pattern)
    if len(pieces) == 1:
        raise CalibrationDataError(
            f"the {what} pattern '{pattern}' names one file; put {{view}} where the views differ, "
            f"as in '{{view}}_{what}.png'."
        )
    groups = {"{view}": "([^/]+)", "*": "([^/]*)", "?": "([^/])"}
    regex = re.compile("".join(groups.get(piece, re.escape(piece)) for piece in pieces))
    found: dict[str, Path] = {}
    for path in folder.glob("/".join("*" * (pattern.count("/") + 1))):
        match = regex.fullmatch(path.relative_to(folder).as_posix())
        if match and path.is_file():
            found["-".join(match.groups())] = path
    if not found:
        raise CalibrationDataError(
            f"{folder}: no file matches the {what} pattern '{pattern}'; {_content(folder)}."
        )
    return found


def _content(folder: Path) -> str:
    names = sorted((path.name for path in folder.iterdir()), key=_natural)
    if not names:
        return "the folder is empty"
    return f"it holds {len(names)} entries such as '{names[0]}' and '{names[-1]}'"


def _example(found: dict[str, Path]) -> str:
    return f"'{found[min(found, key=_natural)].name}'"


def _natural(text: str) -> list[tuple[int, str]]:
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]
