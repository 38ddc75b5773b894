"""The command lines of the checks: generate, diagnose, remains, score, or all of it."""

import itertools
import json
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from benchmarks.sealed.answers import Entry, Outcome, open_answers, write_cases
from benchmarks.sealed.running import diagnose, waiting
from benchmarks.sealed.scores import Score

# Processes share the work; threads inside each would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

HELP = {"help_option_names": ["-h", "--help"]}
SEED = click.option("--seed", type=click.IntRange(0), required=True, help="Draws the cases.")
OUT = click.option("--out", type=click.Path(path_type=Path), required=True, help="JSON lines.")


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


class Check:
    """The command line of a sealed check: its steps, and all of them.

    Args:
        about: What it checks.
        what: What a kind of cases is called; with an s the option that lists them.
        kinds: Those that there are, each with an environment variable that it needs, or "".
        write: Writes a case of a seed, by kind and number, and yields the manifest's entries.
        scores_of: Scores outcomes: figures, and a text to print.
        cases: Of each kind, unless asked for otherwise.
        config: What `tofcorr diagnose` gets without `--config`.
        with_remains: Whether the true gaps of every report are measured.
    """

    def __init__(
        self,
        about: str,
        what: str,
        kinds: Mapping[str, str],
        write: Callable[[int, str, int, Path], Iterable[Entry]],
        scores_of: Callable[[Sequence[Outcome], Path], tuple[list[Score], str]],
        *,
        cases: int = 40,
        config: str = "",
        with_remains: bool = False,
    ) -> None:
        self._what, self._kinds, self._write, self._scores_of = what, kinds, write, scores_of
        self._config = config
        usual = ",".join(name for name, needed in kinds.items() if not needed)
        path, least = click.Path(path_type=Path), click.IntRange(1)
        many = _option("--cases", type=least, default=cases, help="Cases of each kind.")
        own = _option(f"--{what}s", "kinds", default=usual, help="X:400 asks for 400 of X.")
        out = _option("--out", type=path, required=True, help="Folder of the whole check.")
        jobs = _option("--jobs", "--workers", "jobs", type=least, default=2)
        seed = _option("--seed", type=click.IntRange(0), required=True, help="Draws cases.")
        limit = _option("--limit", "limit_s", default=300.0, help="Seconds for one recording.")
        given = _option("--config", type=path, help="Handed to `tofcorr diagnose`.")
        self._steps: dict[Callable[..., None], list[click.Parameter]] = {
            self.generate: [seed, many, own, out],
            self.diagnose: [out, jobs, limit, given],
            **({self.remains: [out, jobs]} if with_remains else {}),
            self.score: [out, jobs],
        }
        every = list(dict.fromkeys(itertools.chain(*self._steps.values())))
        self.group = click.Group(help=about, context_settings=HELP)
        for step, taken in (self._steps | {self.all: every}).items():
            command = click.Command(step.__name__, None, step, taken, help=step.__doc__)
            self.group.add_command(command)

    def generate(self, seed: int, cases: int, kinds: str, out: Path) -> None:
        """Write recordings and, apart, sealed answers."""
        counts = counts_by_name(kinds, cases, list(self._kinds), self._what)
        for name in counts:
            if (needed := self._kinds[name]) and needed not in os.environ:
                raise click.UsageError(f"{name} needs the environment variable {needed}")
        numbered = [(name, index) for name, count in counts.items() for index in range(count)]
        entries = (one for case in numbered for one in self._write(seed, *case, out))
        list(tqdm(write_cases(seed, entries, out), "recordings", unit=""))

    def diagnose(self, out: Path, jobs: int, limit_s: float, config: Path | None) -> None:
        """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
        entries, failed = waiting(out), 0
        text = config.read_text() if config else self._config
        with tqdm(diagnose(out, entries, jobs, limit_s, text), "diagnoses", len(entries)) as runs:
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
        scores, text = self._scores_of(run, out)
        (out / "tables.md").write_text(text + "\n")
        kept = {"format": "tofcorr-sealed-scores", "scores": [asdict(one) for one in scores]}
        (out / "scores.json").write_text(json.dumps(kept, indent=1))
        click.echo(text)

    def all(self, **given: object) -> None:
        """Do all of it, one after the other."""
        for step, taken in self._steps.items():
            step(**{str(one.name): given[str(one.name)] for one in taken})


def _option(*names: str, **values: Any) -> click.Option:  # noqa: ANN401 - click's own
    return click.Option(names, show_default=True, **values)


def kept_rows(
    out: Path, counts: Mapping[str, int], make: Callable[[str, int, Path], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield as many rows of each kind as wanted; those in a file of JSON lines are not remade.

    `make` is told kind, number, and a folder for the recording that is gone afterwards.
    """
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {(row["kind"], row["number"]): row for row in rows}
    wanted = [(kind, number) for kind, count in counts.items() for number in range(count)]
    with out.open("a") as file:
        for kind, number in tqdm(wanted, unit="", disable=None):
            if (kind, number) not in done:
                with tempfile.TemporaryDirectory() as folder:
                    made = make(kind, number, Path(folder) / "recording")
                done[kind, number] = {"kind": kind, "number": number, **made}
                file.write(json.dumps(done[kind, number]) + "\n")
                file.flush()
            yield done[kind, number]
