"""Pairs of depth and infrared images that belong together, by their names."""

from dataclasses import dataclass
from pathlib import Path

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.images.names import matching_files, natural_order
from tofcorr.importing.report import Refusal


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
    depth = matching_files(folder, depth_pattern, "depth")
    infrared = matching_files(folder, infrared_pattern, "infrared")
    shared = sorted(depth.keys() & infrared.keys(), key=natural_order)
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
    return pairs, sorted(alone, key=lambda refusal: natural_order(refusal.view))


def _example(found: dict[str, Path]) -> str:
    return f"'{found[min(found, key=natural_order)].name}'"
