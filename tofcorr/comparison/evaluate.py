"""`tofcorr.evaluate`: models side by side on held-out images."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tofcorr.comparison.evaluation import SetEvaluation, evaluate_set
from tofcorr.comparison.evaluation_figure import comparison_figure
from tofcorr.comparison.evaluation_options import EvaluationOptions
from tofcorr.comparison.evaluation_report import (
    evaluation_mapping,
    evaluation_text,
    write_evaluation,
)
from tofcorr.files.staged import StagedFolder
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.opened import Recordings, opened
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.plausibility.examine import vet
from tofcorr.progress import bar


@dataclass(frozen=True, repr=False)
class EvaluationResult:
    """Held-out errors of several models; its `repr` is the tables that the command prints.

    Attributes:
        sets: One a recording, in the order given.
        options: Models and protocols.
        headlines: What makes a recording doubtful, a sentence each.
    """

    sets: tuple[SetEvaluation, ...]
    options: EvaluationOptions
    headlines: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return what is doubtful, tables, notes and warnings."""
        return "\n\n".join([*self.headlines, evaluation_text(self.sets, self.options)])

    def to_mapping(self) -> dict[str, Any]:
        """Return every number as plain values, as in `evaluation.json`."""
        return evaluation_mapping(self.sets, self.options, self.headlines)

    def plot_comparison(self) -> Figure:
        """Draw the held-out mean absolute error of each model and set, with 95 % intervals."""
        return comparison_figure(self.sets, self.options)


def evaluate(
    recordings: Recordings,
    config: str | Path | Mapping[str, Any] | EvaluationOptions = "paper",
    *,
    out: str | Path | None = None,
    force: bool = False,
) -> EvaluationResult:
    """Compare models on images that they were not fitted to, every recording as a set of its own.

    The protocols are those of Abdo and Borgeat (2010): a random half of the poses held out, and
    k-fold cross-validation by image with paired t-tests; and repeated random splits.

    Args:
        recordings: A folder, an opened recording, or a sequence of either: a row of the tables
            each.
        config: Models and protocols: the name of a shipped configuration (`paper`, `robust`), a
            file, a mapping or `EvaluationOptions`.
        out: Folder for `evaluation.json`, `evaluation.md`, `comparison.png`, `config.yaml` and
            TensorBoard files; nothing may be there yet. None writes nothing.
        force: Compare whatever the recordings look like.

    Raises:
        ConfigError: The configuration is not valid.
        CalibrationDataError: A recording cannot be what it says (see `tofcorr.inspect`);
            A recording cannot be opened, has too few poses for the splits, or
            lacks what a model needs; or `out` exists.
    """
    options = resolve_options(EvaluationOptions, config)
    with StagedFolder(out) if out is not None else nullcontext() as stage:
        sets = opened(recordings)
        options = options.for_recordings(sets)
        data = [Dataset((recording,)) for recording in sets]
        inspections = [vet(one, resolved_planes(options.planes, sets), force=force) for one in data]
        headlines = tuple(one.headline for one in inspections if one.headline)
        names = set_names([recording.path for recording in sets])
        evaluations = []
        total = options.num_fits * len(sets)
        with bar(total, "evaluating", "fit") as advance:
            for name, one, inspection in zip(names, data, inspections, strict=True):
                step = partial(advance, 1)
                evaluations.append(evaluate_set(name, one, options, step, inspection))
        if stage is not None:
            write_evaluation(stage.folder, evaluations, options, headlines)
    return EvaluationResult(tuple(evaluations), options, headlines)


def set_names(paths: Sequence[Path | str]) -> list[str]:
    """Return the recordings' names: those of their folders, numbered where two are alike."""
    names = [Path(path).resolve().name for path in paths]
    return [
        name if names.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(names, start=1)
    ]
