"""`tofcorr.select`: the model that predicts best on held-out images, distances and targets."""

import json
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tofcorr.comparison.held_out_groups import group_frames
from tofcorr.comparison.selection import HeldOutRankings, rank_models
from tofcorr.comparison.selection_figure import ranking_figure
from tofcorr.comparison.selection_options import SelectionOptions
from tofcorr.comparison.selection_report import (
    selection_mapping,
    selection_markdown,
    selection_text,
)
from tofcorr.files.staged import StagedFolder
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.opened import Recordings, opened
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.plausibility.examine import vet
from tofcorr.progress import bar


@dataclass(frozen=True, repr=False)
class SelectionResult:
    """The choice of a model; its `repr` is what the command prints.

    Attributes:
        found: The models ranked, by what was held out.
        options: Models and groupings.
        headline: What makes the recordings doubtful, one sentence; None: nothing.
    """

    found: HeldOutRankings
    options: SelectionOptions
    headline: str | None = None

    @property
    def winner(self) -> str:
        """The model chosen: the simplest within one standard error of the best."""
        return self.found.decisive.winner

    @property
    def ties(self) -> list[str]:
        """The models whose error does not differ significantly from the winner's."""
        return self.found.decisive.ties

    def __repr__(self) -> str:
        """Return what is doubtful, the choice, a table for each grouping, and warnings."""
        page = selection_text(self.found, self.options)
        return f"{self.headline}\n\n{page}" if self.headline else page

    def to_mapping(self) -> dict[str, Any]:
        """Return every number as plain values, as in `selection.json`."""
        return selection_mapping(self.found, self.options) | {"headline": self.headline}

    def plot_ranking(self) -> Figure:
        """Draw by how much each model is behind the best, with 95 % intervals."""
        return ranking_figure(self.found)


def select(
    recordings: Recordings,
    config: str | Path | Mapping[str, Any] | SelectionOptions = "paper",
    *,
    out: str | Path | None = None,
    force: bool = False,
) -> SelectionResult:
    """Compare models on images, distances and targets that they were not fitted to.

    Args:
        recordings: A folder, an opened recording, or a sequence of either, all of one camera; they
            are taken together.
        config: Models and what is held out: the name of a shipped configuration (`paper`,
            `all_models`), a file, a mapping or `SelectionOptions`.
        out: Folder for `selection.json` and `selection.md`; nothing may be there yet. None writes
            nothing.
        force: Compare whatever the recordings look like.

    Raises:
        ConfigError: The configuration is not valid.
        CalibrationDataError: A recording cannot be what it says (see `tofcorr.inspect`);
            A recording cannot be opened or lacks what a model needs, nothing can
            be held out, or `out` exists.
    """
    options = resolve_options(SelectionOptions, config)
    with StagedFolder(out) if out is not None else nullcontext() as stage:
        dataset = Dataset(opened(recordings))
        planes = resolved_planes(options.planes, dataset.recordings)
        inspection = vet(dataset, planes, force=force)
        headline = inspection.headline
        groups, _ = group_frames(dataset, options)
        total = len(options.models) * sum(len(held_out) for held_out in groups.values())
        with bar(total, "comparing", "fit") as advance:
            result = SelectionResult(
                rank_models(dataset, options, partial(advance, 1), inspection), options, headline
            )
        if stage is not None:
            page = selection_markdown(result.found, options, headline)
            (stage.folder / "selection.md").write_text(page, encoding="utf-8")
            (stage.folder / "selection.json").write_text(
                json.dumps(result.to_mapping(), indent=1, allow_nan=False) + "\n", encoding="utf-8"
            )
    return result
