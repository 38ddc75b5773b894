"""`tofcorr.evaluate`: models side by side on held-out images."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tofcorr.comparison.experiment import METRICS, VIEWS, Experiment, compare
from tofcorr.comparison.options import (
    BEFORE,
    HAND_EYE_ONLY,
    EvaluationOptions,
    comparability_notes,
    masks_of,
)
from tofcorr.comparison.page import held_out_figure, render
from tofcorr.comparison.statistics import Estimate, Table
from tofcorr.digits import aligned, at_most
from tofcorr.files import staged_folder, write_json
from tofcorr.options import dump_yaml, resolve_options
from tofcorr.pages.drawing import save_figure
from tofcorr.pixels.dataset import Dataset, Recordings, opened, resolved_planes
from tofcorr.plausibility.examine import vet
from tofcorr.progress import LOG, event_writer
from tofcorr.training.report import number_or_none
from tofcorr.version import __version__


@dataclass(frozen=True, repr=False)
class EvaluationResult:
    """Held-out errors of several models; its `repr` is the short text that the command prints.

    Attributes:
        sets: One a recording, in the order given.
        options: Models and protocols.
        headlines: What makes a recording doubtful, a sentence each.
    """

    sets: Sequence[Experiment]
    options: EvaluationOptions
    headlines: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return the best model, the held-out error of each, and a warning: 11 lines at most."""
        sets = self._errors.items()
        first, *_ = ordered = list(next(iter(self._errors.values())))
        sizes = ", ".join(f"{own[first].mean:.2f} mm on {name}" for name, own in sets)
        verdict = f"{first} predicts held-out images best: off by {sizes}."
        rows = [[name, *(_interval(own[name]) for _, own in sets)] for name in ordered]
        heads = ["mean absolute error, mm", *self._errors]
        table = at_most(6, aligned([heads, *rows]))
        said = [*self.headlines, *(f"Warning: {text}" for text in self.warnings)]
        return "\n".join([verdict, *table, *at_most(3, said)])

    @property
    def details(self) -> str:
        """What is doubtful, all tables, notes and warnings."""
        return "\n\n".join(self._page([table.text() for table in self.tables()]))

    def markdown(self) -> str:
        """Return the same as a page of Markdown."""
        page = self._page([table.markdown() for table in self.tables()])
        return "\n\n".join(["# Evaluation", *page]) + "\n"

    def _page(self, tables: Sequence[str]) -> list[str]:
        notes = filter(None, [" ".join(comparability_notes(self.options))])
        return [*self.headlines, *tables, *notes, *(f"Warning: {text}" for text in self.warnings)]

    @property
    def warnings(self) -> list[str]:
        """What limits the numbers, one sentence each, with the set's name."""
        return [f"{one.name}: {text}" for one in self.sets for text in one.warnings]

    def to_mapping(self) -> dict[str, Any]:
        """Return every number as plain values, unknown ones as None, as in `evaluation.json`."""
        options = self.options
        return {
            "format": "tofcorr-evaluation",
            "version": 1,
            "tofcorr": __version__,
            "headlines": list(self.headlines),
            "columns": options.columns,
            "seed": options.seed,
            "outlier_window_mm": options.outlier_window_mm,
            "measured_on": masks_of(options).to_mapping() | {"planes": options.planes},
            "notes": comparability_notes(options),
            "sets": [
                {
                    "name": one.name,
                    "frames": one.dataset.num_frames,
                    "targets": one.targets,
                    "pixels": one.fitter.num_pixels,
                    "left_out": one.left_out,
                    "hand_eye_estimated": one.hand_eye_estimated,
                    "hand_eye": one.hand_eye,
                    "by_wall_rms_mm": {kind: one.by_wall(kind) for kind in one.splits},
                    "held_out": {kind: self._held_out(one, kind) for kind in one.splits},
                    "warnings": one.warnings,
                }
                for one in self.sets
            ],
        }

    def _held_out(self, one: Experiment, protocol: str) -> dict[str, Any]:
        """Return the numbers of one set and protocol as plain values."""
        splits, tests = list(one.splits[protocol].values()), []
        for metric in METRICS:
            for first, second in pairs(self.options.columns) if len(splits) > 1 else []:
                found = one.estimate(protocol, metric, first, second)
                tests.append(
                    {
                        "metric": metric,
                        "first": first,
                        "second": second,
                        "first_minus_second_mm": found.to_mapping(),
                        "p_value": number_or_none(found.p_value),
                        "degrees_of_freedom": found.degrees_of_freedom,
                        "significant": found.significant,
                    }
                )
        return {
            "test_frames": [test.tolist() for test in splits],
            "error_mm": {
                metric: {
                    column: one.estimate(protocol, metric, column).to_mapping()
                    | {"splits": [number_or_none(value) for value in values.tolist()]}
                    for column, values in by_column.items()
                }
                for metric, by_column in one.values[protocol].items()
            },
            "paired_tests": tests,
        }

    def plot_comparison(self) -> Figure:
        """Draw the held-out mean absolute error of each model and set, with 95 % intervals."""
        label = "held-out mean absolute error, mm"
        return held_out_figure(self._errors, label, [self._best(one) for one in self._errors])

    @cached_property
    def _errors(self) -> dict[str, dict[str, Estimate]]:
        """Held-out mean absolute errors by set and column, the least of all sets first."""
        protocol = "folds" if self.options.folds else "half"
        found = {
            k: [one.estimate(protocol, "mean_abs_mm", k) for one in self.sets]
            for k in self.options.columns
        }
        ordered = sorted(found, key=lambda k: sum(one.mean for one in found[k]))
        return {one.name: {k: found[k][i] for k in ordered} for i, one in enumerate(self.sets)}

    def _best(self, name: str) -> str:
        """Return the model of the smallest error on a set."""
        found = {k: v for k, v in self._errors[name].items() if k not in (BEFORE, HAND_EYE_ONLY)}
        return min(found, key=lambda k: found[k].mean)

    def _verdict(self, name: str) -> str:
        own, best = self._errors[name], self._best(name)
        bare = (
            f"{own[BEFORE].mean:.2f} before, {own[HAND_EYE_ONLY].mean:.2f} with the hand-eye alone"
        )
        return f"{name}: {best} has the smallest held-out error, {own[best].mean:.2f} mm ({bare})."

    def page(self) -> str:
        """Return the same as one HTML page with a picture."""
        return render(
            "Models on frames that they were not fitted to",
            [*self.headlines, *map(self._verdict, self._errors)],
            self.plot_comparison(),
            self.tables(),
            comparability_notes(self.options),
            self.warnings,
        )

    def write(self, folder: Path) -> None:
        """Write numbers, tables, page, picture, options, and TensorBoard's files into a folder."""
        write_json(folder / "evaluation.json", self.to_mapping())
        (folder / "evaluation.md").write_text(self.markdown(), encoding="utf-8")
        (folder / "report.html").write_text(self.page(), encoding="utf-8")
        options = dump_yaml(self.options.to_mapping())
        (folder / "config.yaml").write_text(options, encoding="utf-8")
        image = save_figure(self.plot_comparison(), folder / "comparison.png")
        with event_writer(folder / "tb") as writer:
            writer.add_image("comparison/held_out_error", image, dataformats="HWC")
            pages = [table.markdown() for table in self.tables()]
            writer.add_text("comparison/tables", "\n\n".join(pages))

    def tables(self) -> list[Table]:
        """Return the tables of the protocols that the options ask for."""
        found = [self._half_table()]
        if self.options.folds:
            found += [self._folds_table(), self._tests_table("folds", "mean_abs_mm")]
        if self.options.repeats.number:
            kinds = {"rms_mm": "distance to the plane", "rms_z_mm": "error of the z depth"}
            kinds |= {f"{of}_mm": f"error in z {of.replace('_', ' ')}" for of in VIEWS}
            found += [self._repeats_table(metric, kind) for metric, kind in kinds.items()]
            found.append(self._tests_table("repeats", "rms_mm"))
        found.append(self._views_table())
        walls = any(len(one.targets) > 1 for one in self.sets)
        return [*found, self._walls_table()] if walls else found

    def _views_table(self) -> Table:
        rows = []
        for one, of in product(self.sets, VIEWS):
            errors = one.values["half"][f"{of}_mm"]
            if of == VIEWS[-1] and errors == one.values["half"]["rms_z_mm"]:
                continue  # No plane has a covariance.
            cells = [f"{errors[column][0]:.2f}" for column in self.options.columns]
            rows.append([f"{one.name}: {of.replace('_', ' ')}", *cells])
        note = "Between views: offset and tilts of whole images, beyond any model of a pixel."
        return self._table(
            "RMS error of z depth on that half, between views and within them, mm", rows, note
        )

    def _table(self, title: str, rows: list[list[str]], note: str) -> Table:
        seed = f" Seed {self.options.seed}." if "seed" not in note else ""
        return Table(title, ["set", *self.options.columns], rows, f"{note}{seed}")

    def _half_table(self) -> Table:
        rows = []
        for one in self.sets:
            mean, rms = (one.values["half"][metric] for metric in ("mean_abs_mm", "rms_mm"))
            images = ", ".join(f"{count} {target}" for target, count in one.targets.items())
            cells = [f"{mean[name][0]:.2f} ({rms[name][0]:.2f})" for name in self.options.columns]
            rows.append([f"{one.name} ({images})", *cells])
        held_out = f"{100 * self.options.test_fraction:.0f} % of the poses held out"
        title = f"Table 1. Mean absolute error per pixel (RMS), mm, on {held_out}"
        note = "'hand-eye only': hand-eye refitted, no depth correction."
        return self._table(title, rows, f"One random split a set, seed {self.options.seed}. {note}")

    def _walls_table(self) -> Table:
        shown = {"folds" if self.options.folds else "half": "images", "walls": "wall"}
        rows = []
        for one, (protocol, what) in product(self.sets, shown.items()):
            walls = one.by_wall(protocol) if protocol in one.splits else {}
            cells = {wall: [f"{k:.2f}" for k in errors.values()] for wall, errors in walls.items()}
            rows += [[f"{one.name}, {wall}, {what}", *own] for wall, own in cells.items()]
        note = "'images': some images of each wall held out; 'wall': all of one wall, in turn."
        return self._table("Held-out RMS distance to each wall, mm", rows, note)

    def _folds_table(self) -> Table:
        folds, columns = self.options.folds, self.options.columns
        found = [[one.estimate("folds", "mean_abs_mm", c) for c in columns] for one in self.sets]
        first = found[0][columns.index(HAND_EYE_ONLY)]
        factor = first.half_width / first.standard_error if first.standard_error else np.nan
        rows = [[one.name, *map(_interval, row)] for one, row in zip(self.sets, found, strict=True)]
        title = f"Table 2. Mean absolute error per pixel, mm, {folds}-fold cross-validation"
        note = f"Mean over the folds ± {factor:.2f} SE (95 %, Student's t)."
        return self._table(title, rows, note)

    def _repeats_table(self, metric: str, kind: str) -> Table:
        rows, repeats = [], self.options.repeats
        for one in self.sets:
            found = [one.estimate("repeats", metric, column) for column in self.options.columns]
            rows.append([one.name, *(f"{e.mean:.2f} ± {e.standard_deviation:.2f}" for e in found)])
            ends = [f"{low:.2f}–{high:.2f}" for low, high in (e.interval for e in found)]
            rows.append(["  95 % interval", *ends])
        splits = f"{repeats.number} random splits by pose"
        title = f"Held-out RMS {kind}, mm, {splits}, {100 * repeats.test_fraction:.0f} % held out"
        note = "Mean ± standard deviation; the interval allows for the overlap of the splits."
        return self._table(title, rows, note)

    def _tests_table(self, protocol: str, metric: str) -> Table:
        rows, dof = [], 0
        for one in self.sets:
            for first, second in main_pairs(self.options.columns):
                found = one.estimate(protocol, metric, first, second)
                dof = found.degrees_of_freedom
                share = abs(found.mean) / one.estimate(protocol, metric, first).mean
                better = f"{second if found.mean > 0 else first} better by {100 * share:.0f} %"
                verdict = better if found.significant else "no difference found"
                cells = [_interval(found), f"{found.p_value:.2g}", verdict]
                rows.append([f"{one.name}: {first} / {second}", *cells])
        name = "mean absolute error" if metric == "mean_abs_mm" else "RMS"
        source = "folds" if protocol == "folds" else "random splits, corrected for their overlap"
        title = f"Paired t-tests of held-out {name} on the {source}"
        header = ["set: first / second", "first − second, mm", "p", "verdict"]
        note = f"± 95 %, Student's t with {dof} degrees of freedom; all pairs: evaluation.json."
        return Table(title, header, rows, note)


def evaluate(
    recordings: Recordings,
    config: str | Path | Mapping[str, Any] | EvaluationOptions = "paper",
    *,
    out: str | Path | None = None,
    force: bool = False,
    tell: Callable[[str], object] = LOG.info,
) -> EvaluationResult:
    """Compare models on images that they were not fitted to, every recording as a set of its own.

    The protocols are those of Abdo and Borgeat (2010): a random half of the poses held out, and
    k-fold cross-validation by image with paired t-tests; and repeated random splits.
    Ctrl-C ends it early: the result then holds the models that were finished.

    Args:
        recordings: A folder, an opened recording, or a sequence of either: a row of the tables
            each.
        config: Models and protocols: the name of a shipped configuration (`paper`, `robust`), a
            file, a mapping or `EvaluationOptions`.
        out: Folder for `evaluation.json`, `evaluation.md`, `report.html`, `comparison.png`,
            `config.yaml` and TensorBoard files; nothing may be there yet. None writes nothing.
        force: Compare whatever the recordings look like.
        tell: Called with what the work will cost, and with a line as each model ends.

    Raises:
        ConfigError: The configuration is not valid.
        CalibrationDataError: A recording cannot be what it says (see `tofcorr.inspect`);
            A recording cannot be opened, has too few poses for the splits, or
            lacks what a model needs; or `out` exists.
    """
    options = resolve_options(EvaluationOptions, config)
    with staged_folder(out) if out is not None else nullcontext() as folder:
        sets = opened(recordings)
        options = options.for_recordings(sets)
        data = [Dataset((recording,)) for recording in sets]
        inspections = [vet(one, resolved_planes(options.planes, sets), force=force) for one in data]
        headlines = tuple(one.headline for one in inspections if one.headline)
        names = [recording.path.resolve().name for recording in sets]
        names = [k if names.count(k) == 1 else f"{k} ({n})" for n, k in enumerate(names, start=1)]
        parts = zip(names, data, inspections, strict=True)
        evaluations = tuple(Experiment(name, one, options, seen) for name, one, seen in parts)
        done = compare(evaluations, tell)
        result = EvaluationResult(evaluations, options.only(done), headlines)
        if folder is not None:
            result.write(folder)
    return result


def pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs of columns that are tested against each other: all but those of `before`."""
    return list(combinations([column for column in columns if column != BEFORE], 2))


def main_pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs that tables show: neighbouring columns, and each model with the first."""
    models = [column for column in columns if column not in (BEFORE, HAND_EYE_ONLY)]
    neighbours = set(pairwise(columns))
    return [pair for pair in pairs(columns) if pair[0] == models[0] or pair in neighbours]


def _interval(found: Estimate) -> str:
    """Return a mean with its interval; of one split no interval is known."""
    around = f" ± {found.half_width:.2f}" if np.isfinite(found.half_width) else ""
    return f"{found.mean:.2f}{around}"
