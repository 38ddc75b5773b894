"""The command lines of the checks: generate, diagnose, remains, score, or all of it."""

import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from benchmarks.sealed.answers import Entry, Outcome, open_answers, write_cases
from benchmarks.sealed.running import Plan, diagnose, waiting
from benchmarks.sealed.scores import Score

# Processes share the work; threads inside each would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

HELP = {"help_option_names": ["-h", "--help"]}
SEED = click.option("--seed", type=click.IntRange(0), required=True, help="Draws the cases.")
OUT = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="A line a recording, as JSON."
)


def counts_by_name(text: str, cases: int, known: Collection[str], what: str) -> dict[str, int]:
    """Return the number of each kind from text such as `A,B,C:400`.

    Args:
        text: Names; a number behind a colon replaces `cases`.
        cases: How many of a name without a number.
        known: The names that there are.
        what: What a name names, for the refusal.

    Raises:
        BadParameter: A name is unknown.
    """
    counts = {}
    for part in text.split(","):
        name, _, number = part.strip().partition(":")
        if name not in known:
            raise click.BadParameter(f"no {what} {name!r}: expected some of {', '.join(known)}")
        counts[name] = int(number) if number else cases
    return counts


@dataclass(frozen=True)
class Check:
    """The command line of a sealed check.

    Attributes:
        about: What it checks.
        option: Name of the option that lists kinds of cases.
        kinds: Those that there are, each with an environment variable that it needs, or "".
        write: Writes cases of a seed and yields the manifest's entries.
        scores_of: Scores outcomes: figures, and a text to print.
        cases: Of each kind, unless asked for otherwise.
        config: What `tofcorr diagnose` gets without `--config`.
        with_remains: Whether the true gaps of every report are measured.
    """

    about: str
    option: str
    kinds: Mapping[str, str]
    write: Callable[[int, dict[str, int], Path], Iterable[Entry]]
    scores_of: Callable[[Sequence[Outcome], Path], tuple[list[Score], str]]
    cases: int
    config: str = ""
    with_remains: bool = False

    def generate(self, seed: int, cases: int, kinds: str, out: Path) -> None:
        """Write recordings and, apart, sealed answers."""
        counts = counts_by_name(kinds, cases, list(self.kinds), self.option.removesuffix("s"))
        for name in counts:
            if (needed := self.kinds[name]) and needed not in os.environ:
                raise click.UsageError(f"{name} needs the folder of real recordings in ${needed}")
        for _ in tqdm(write_cases(seed, self.write(seed, counts, out), out), "recordings", unit=""):
            pass

    def diagnose(self, out: Path, jobs: int, limit_s: float, config: Path | None) -> None:
        """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
        entries, failed = waiting(out), 0
        plan = Plan(jobs, limit_s, config.read_text() if config else self.config)
        with tqdm(diagnose(out, entries, plan), "diagnoses", len(entries), unit="") as runs:
            for code in runs:
                failed += code != 0
                runs.set_postfix(failed=failed)

    def remains(self, out: Path, jobs: int) -> None:
        """Measure the true gaps of every report: what its models leave of noiseless distances."""
        from benchmarks.sealed import remains

        names = remains.waiting(out)
        same = list(tqdm(remains.measure(out, names, jobs), "remains", len(names), unit=""))
        if other := same.count(False):
            click.echo(f"{other} name other effects than their reports: no truth.", err=True)

    def score(self, out: Path, jobs: int) -> None:
        """Open the answers, check their seals, score, and write `tables.md` and `scores.json`."""
        with ProcessPoolExecutor(jobs) as pool:
            outcomes = list(tqdm(open_answers(out, pool.map), desc="answers", unit=""))
        run = [one for one in outcomes if one.said.failure != "not run"]
        if left := len(outcomes) - len(run):
            click.echo(f"{left} of {len(outcomes)} recordings are not diagnosed.", err=True)
        scores, text = self.scores_of(run, out)
        (out / "tables.md").write_text(text + "\n")
        kept = {"format": "tofcorr-sealed-scores", "scores": [asdict(one) for one in scores]}
        (out / "scores.json").write_text(json.dumps(kept, indent=1))
        click.echo(text)

    def group(self) -> click.Group:
        """The commands, each a step, and `all` of them."""
        usual = ",".join(name for name, needed in self.kinds.items() if not needed)
        path, at_least_one = click.Path(path_type=Path), click.IntRange(1)
        limit, many = "Seconds for one recording.", "Cases of each kind."
        kinds = f"Which {self.option}; X:400 asks for 400 of X."
        options = {
            "seed": _option("--seed", type=click.IntRange(0), required=True, help="Draws cases."),
            "cases": _option("--cases", type=at_least_one, default=self.cases, help=many),
            "kinds": _option(f"--{self.option}", "kinds", default=usual, help=kinds),
            "out": _option("--out", type=path, required=True, help="Folder of the whole check."),
            "jobs": _option("--jobs", "--workers", "jobs", type=at_least_one, default=2),
            "limit_s": _option("--limit", "limit_s", default=300.0, help=limit),
            "config": _option("--config", type=path, help="Handed to `tofcorr diagnose`."),
        }
        steps: dict[Callable[..., None], tuple[str, ...]] = {
            self.generate: ("seed", "cases", "kinds", "out"),
            self.diagnose: ("out", "jobs", "limit_s", "config"),
            **({self.remains: ("out", "jobs")} if self.with_remains else {}),
            self.score: ("out", "jobs"),
        }

        def everything(**given: object) -> None:
            """Do all of it, one after the other."""
            for step, taken in steps.items():
                step(**{name: given[name] for name in taken})

        commands = {step.__name__: (step, taken) for step, taken in steps.items()}
        commands["all"] = (everything, tuple(options))
        group = click.Group(help=self.about, context_settings=HELP)
        for name, (step, taken) in commands.items():
            params: list[click.Parameter] = [options[one] for one in taken]
            group.add_command(click.Command(name, None, step, params, help=step.__doc__))
        return group


def _option(*names: str, **values: Any) -> click.Option:  # noqa: ANN401 - click's own
    return click.Option(names, show_default=True, **values)


def kept_rows(
    out: Path, wanted: Iterable[tuple[str, int]], make: Callable[[str, int], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield a row for each kind and number wanted; those in a file of JSON lines are not remade."""
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {(row["kind"], row["number"]): row for row in rows}
    with out.open("a") as file:
        for kind, number in wanted:
            if (kind, number) not in done:
                done[kind, number] = {"kind": kind, "number": number, **make(kind, number)}
                file.write(json.dumps(done[kind, number]) + "\n")
                file.flush()
            yield done[kind, number]
