"""`tofcorr.select`: the model that predicts best on held-out images, distances and targets."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.comparison.experiment import Experiment, compare
from tofcorr.comparison.options import SelectionOptions, comparability_notes, masks_of
from tofcorr.comparison.page import held_out_figure, render
from tofcorr.comparison.statistics import Ranking, Table
from tofcorr.digits import aligned, at_most
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.files import staged_folder, write_json
from tofcorr.fit.walls import name_walls
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, Recordings, opened, resolved_planes
from tofcorr.pixels.passes import FrameErrors
from tofcorr.plausibility.examine import vet
from tofcorr.progress import LOG
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.report import number_or_none

_METRICS = {"mean_abs": "mean absolute", "rms": "RMS"}


@dataclass(frozen=True, repr=False)
class SelectionResult:
    """The choice of a model; its `repr` is what the command prints.

    Attributes:
        rankings: The models ranked, by what was held out.
        experiment: The models fitted, and the groups held out in turn.
        options: Models and groupings.
        headline: What makes the recordings doubtful, one sentence; None: nothing.
    """

    rankings: dict[str, Ranking]
    experiment: Experiment
    options: SelectionOptions
    headline: str | None = None

    @property
    def decisive(self) -> Ranking:
        """The ranking that decides: the first one asked for that was possible."""
        return next(iter(self.rankings.values()))

    @property
    def winner(self) -> str:
        """The model chosen: the simplest within one standard error of the best."""
        return self.decisive.winner

    @property
    def ties(self) -> list[str]:
        """The models whose error does not differ significantly from the winner's."""
        return self.decisive.ties

    @property
    def verdict(self) -> str:
        """The choice in one paragraph."""
        first, *others = self.rankings
        decisive, winner = self.decisive, self.winner
        best = "" if decisive.best == winner else f", {decisive.best}"
        text = (
            f"{winner} is the choice ({decisive.errors[winner].mean:.2f} mm on {first}s held out)"
        )
        text += f": the simplest model within one standard error of the best{best}."
        if decisive.ties:
            text += f" Not significantly different from it: {', '.join(decisive.ties)}."
        for by in others:
            ranking = self.rankings[by]
            if winner != ranking.winner and winner not in ranking.ties:
                behind = f"{winner} is {ranking.behind[winner].mean:.2f} mm behind the best there"
                text += f" With {by}s held out {ranking.winner} is better: {behind}."
        return text

    def __repr__(self) -> str:
        """Return the choice, the best models' held-out errors, and a warning: 11 lines at most."""
        rankings, decisive = self.rankings.values(), self.decisive
        rows = [
            [name, str(decisive.complexity[name])]
            + [
                f"{one.errors[name].mean:.2f} ± {one.errors[name].standard_error:.2f}"
                for one in rankings
            ]
            for name in self._ordered
        ]
        heads = [f"{by}s held out, mm" for by in self.rankings]
        table = at_most(6, aligned([["model", "unknowns", *heads], *rows]))
        doubtful = [self.headline] if self.headline else []
        return "\n".join([self.verdict, *doubtful, *table, *at_most(2, self._warnings)])

    @property
    def _ordered(self) -> list[str]:
        """The models, the one with the smallest decisive error first, as text and picture do."""
        errors = self.decisive.errors
        return sorted(errors, key=lambda name: errors[name].mean)

    @property
    def details(self) -> str:
        """The choice, a table for each grouping, and all warnings."""
        return self._page([table.text() for table in self.tables()])

    @property
    def _warnings(self) -> list[str]:
        return [f"Warning: {warning}" for warning in self.experiment.warnings]

    def markdown(self) -> str:
        """Return the same as a page of Markdown."""
        page = self._page([table.markdown() for table in self.tables()])
        return f"# Choice of a model\n\n{page}\n"

    def page(self) -> str:
        """Return the same as one HTML page with a picture."""
        metric = _METRICS[self.options.metric]
        ordered = {
            f"{by}s held out": {name: ranking.errors[name] for name in self._ordered}
            for by, ranking in self.rankings.items()
        }
        best = [ranking.best for ranking in self.rankings.values()]
        return render(
            "Choice of a model",
            [*filter(None, [self.headline]), self.verdict],
            held_out_figure(ordered, f"held-out {metric} error, mm", best),
            self.tables(),
            self._notes,
            self.experiment.warnings,
        )

    def tables(self) -> list[Table]:
        """Return a table for each grouping, the model with the smallest error first."""
        metric = _METRICS[self.options.metric]
        found, header = [], ["model", "unknowns", "error", "behind the best", "verdict"]
        for by, ranking in self.rankings.items():
            ordered = sorted(ranking.errors.items(), key=lambda item: item[1].mean)
            rows = [self._row(ranking, name) for name, _ in ordered]
            title = f"{by.capitalize()}s held out: {metric} error, mm"
            parts = self.experiment.splits[by]
            names = "; ".join(parts) if by != "image" else f"{len(parts)} random parts"
            held_out = f"Held out in turn: {names}."
            found.append(Table(title, header, rows, held_out))
        return found

    def _row(self, ranking: Ranking, name: str) -> list[str]:
        one, behind = ranking.errors[name], ranking.behind[name]
        low, high = behind.interval
        return [
            name,
            str(ranking.complexity[name]),
            f"{one.mean:.2f} ± {one.standard_error:.2f}",
            "best" if name == ranking.best else f"{behind.mean:.2f} [{low:.2f}, {high:.2f}]",
            "winner" if name == ranking.winner else "tie" if name in ranking.ties else "",
        ]

    def _page(self, tables: list[str]) -> str:
        parts = [self.verdict, *filter(None, [self.headline]), *tables, *self._notes]
        return "\n\n".join([*parts, *self._warnings])

    @property
    def _notes(self) -> list[str]:
        """How the numbers were found, and what could not be held out."""
        skipped = self.experiment.skipped.items()
        return [
            *comparability_notes(self.options),
            *(f"Not held out by {by}: {why}" for by, why in skipped),
            "Errors are distances to the plane, mean over the held-out poses ± one standard error. "
            "Behind the best: paired difference, pose by pose, with its 95 % interval.",
        ]

    def to_mapping(self) -> dict[str, Any]:
        """Return every number as plain values, as in `selection.json`."""
        options, found = self.options, self.experiment
        return {
            "format": "tofcorr-selection",
            "version": 1,
            "metric": options.metric,
            "winner": self.winner,
            "ties": self.ties,
            "verdict": self.verdict,
            "by": {
                by: {
                    "held_out": {name: len(test) for name, test in found.splits[by].items()},
                    "best": ranking.best,
                    "winner": ranking.winner,
                    "ties": ranking.ties,
                    "models": {
                        name: {
                            "unknowns": ranking.complexity[name],
                            "error_mm": one.mean,
                            "error_se_mm": number_or_none(one.standard_error),
                            "behind_best_mm": ranking.behind[name].mean,
                            "behind_best_se_mm": number_or_none(
                                ranking.behind[name].standard_error
                            ),
                            "behind_best_ci95_mm": ranking.behind[name].to_mapping()["ci"],
                        }
                        for name, one in ranking.errors.items()
                    },
                }
                for by, ranking in self.rankings.items()
            },
            "measured_on": masks_of(options).to_mapping() | {"planes": options.planes},
            "notes": comparability_notes(options),
            "skipped": found.skipped,
            "left_out": found.left_out,
            "warnings": found.warnings,
            "headline": self.headline,
        }


def select(
    recordings: Recordings,
    config: str | Path | Mapping[str, Any] | SelectionOptions = "paper",
    *,
    out: str | Path | None = None,
    force: bool = False,
    tell: Callable[[str], object] = LOG.info,
) -> SelectionResult:
    """Compare models on images, distances and targets that they were not fitted to.

    Ctrl-C ends it early: the result then holds the models that were finished.

    Args:
        recordings: A folder, an opened recording, or a sequence of either, all of one camera; they
            are taken together.
        config: Models and what is held out: the name of a shipped configuration (`paper`,
            `all_models`), a file, a mapping or `SelectionOptions`.
        out: Folder for `selection.json`, `selection.md` and `report.html`; nothing may be there
            yet. None writes nothing.
        force: Compare whatever the recordings look like.
        tell: Called with what the work will cost, and with a line as each model ends.

    Raises:
        ConfigError: The configuration is not valid.
        CalibrationDataError: A recording cannot be what it says (see `tofcorr.inspect`);
            A recording cannot be opened or lacks what a model needs, nothing can
            be held out, or `out` exists.
    """
    options = resolve_options(SelectionOptions, config)
    with staged_folder(out) if out is not None else nullcontext() as folder:
        dataset = Dataset(opened(recordings))
        planes = resolved_planes(options.planes, dataset.recordings)
        inspection = vet(dataset, planes, force=force)
        found = Experiment("", dataset, options, inspection)
        options = options.only(compare([found], tell))
        trainings = [found.options.training(model) for model in found.options.models]
        complexity = {k.name: _complexity(k, found.fitter.domain, dataset) for k in trainings}
        rankings = {}
        for by, groups in found.errors.items():
            errors = {
                k: errors_by_pose(dataset, found.held_out(by, k), options) for k in complexity
            }
            rankings[by] = Ranking(errors, complexity, len(groups))
        # What the page says of the models is what was asked for.
        result = SelectionResult(rankings, found, options, inspection.headline)
        if folder is not None:
            (folder / "selection.md").write_text(result.markdown(), encoding="utf-8")
            (folder / "report.html").write_text(result.page(), encoding="utf-8")
            write_json(folder / "selection.json", result.to_mapping())
    return result


def errors_by_pose(
    dataset: Dataset, held_out: FrameErrors, options: SelectionOptions
) -> np.ndarray:
    """Return a model's held-out error of each pose with a usable pixel, in the poses' order, mm."""
    absolute = options.metric == "mean_abs"
    poses = dataset.pose_groups()[held_out.frames]
    total = np.bincount(poses, held_out.absolute if absolute else held_out.squared)
    pixels = np.bincount(poses, held_out.count)
    mean = total[pixels > 0] / pixels[pixels > 0]
    return 1e3 * (mean if absolute else np.sqrt(mean))


def _complexity(training: TrainingOptions, domain: Domain, dataset: Dataset) -> int:
    """Return how many unknowns a model has beside the hand-eye transform."""
    unknowns = ErrorModel(training.model, domain).coefficient_vector().numel()
    if training.model.with_columns() != training.model:
        unknowns += domain.height * domain.width
    if training.planes == "unknown":
        unknowns += 3 * len(name_walls(dataset)[1])
    if training.residual is not None:
        unknowns += training.residual.network.width
    return unknowns
