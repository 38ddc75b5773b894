"""What is left of files when commands are killed, or the disk is full, or a copy was cut short.

    python -m benchmarks.faults --kills 1000 --seed 1 --out faults.json

Every command runs on a tiny recording, in a process forked from this one. It is ended by SIGKILL,
SIGTERM or SIGINT: half of the times at a moment drawn from its whole duration, half of the times at
one of its operations on files. Then

- what was there before must be there unchanged; a file that the command replaces is old or new;
- at the place of its output there is nothing, or all of it: a reader of that format is asked;
- after SIGTERM and SIGINT no temporary file is left; after SIGKILL the next run removes it;
- a run again, for every third kill, succeeds; an interrupted training goes on with `--resume`.

A full disk is a small file system in memory where this process may mount one, a limit on the size
of files, and a failure of every new file from some operation on. Copies of all outputs are cut at a
random length: readers must refuse them, or read the same.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.killing.commands import Command, commands, drawn, prepare
from benchmarks.killing.runs import Ended, Moment, run
from benchmarks.killing.truncated import cut_copies

_SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_AGAIN = 3
"""Every so many kills, the command is run again."""


class Trial:
    """Runs of commands on copies of one workspace, and what came of them.

    Args:
        ready: The workspace that every run starts from.
        place: Where its copies and logs go.
        generator: Source of randomness.
    """

    def __init__(self, ready: Path, place: Path, generator: random.Random) -> None:
        self.ready, self.place, self.generator = ready, place, generator
        self.before = digests(ready)
        self.outcomes: Counter[str] = Counter()
        self.failures: list[dict[str, object]] = []
        self.whole: dict[str, Ended] = {}

    def fresh(self) -> Path:
        """Return a new copy of the workspace."""
        folder = self.place / "work"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(tempfile.gettempdir())
        Path(tempfile.gettempdir()).mkdir()
        shutil.copytree(self.ready, folder)
        return folder

    def measure(self, command: Command) -> Ended:
        """Return how a command ends to which nothing happens."""
        if command.name not in self.whole:
            folder = self.fresh()
            self.whole[command.name] = ended = run(command.words, folder, self.place / "log")
            if ended.code:
                raise click.ClickException(f"{command.name} fails undisturbed: {ended.told}")
            command.check(folder / command.out)
        return self.whole[command.name]

    def kill(self, command: Command) -> None:
        """End one run by a signal and look at what is left."""
        whole, draw = self.measure(command), self.generator
        what = draw.choice(_SIGNALS)
        if draw.random() < 0.5:
            moment = Moment(what=what, after=draw.uniform(0, 1.05 * whole.seconds))
        else:
            moment = Moment(what=what, operation=draw.randint(1, whole.operations))
        folder = self.fresh()
        ended = run(command.words, folder, self.place / "log", moment)
        self.outcomes[f"{what.name}: exit {ended.code}"] += 1
        self._expect(not ended.hung, command, "does not end", ended)
        allowed = {0, 130, -what} | ({2} if what != signal.SIGKILL else set())
        self._expect(ended.code in allowed, command, "another exit code", ended)
        self._expect("Traceback" not in ended.told, command, "a traceback", ended)
        self.look(command, folder, ended, left=what == signal.SIGKILL or ended.code < 0)
        if draw.randrange(_AGAIN) == 0:
            self.again(command, folder)

    def look(self, command: Command, folder: Path, ended: Ended, *, left: bool) -> None:
        """Compare what is left with what was there, and read the output if there is one."""
        after = digests(folder)
        damaged = [n for n, d in self.before.items() if after.get(n) != d and n != command.out]
        self._expect(not damaged, command, f"damaged {damaged[:3]}", ended)
        out = folder / command.out
        if os.path.lexists(out):
            self.outcomes["output whole"] += 1
            try:
                command.check(out)
            except Exception as error:  # noqa: BLE001 - any failure to read it counts
                self._fail(command, f"half an output: {error!r}"[:300], ended)
        else:
            self.outcomes["no output"] += 1
            self._expect(not command.replaces, command, "the older file is gone", ended)
        if hidden(folder):
            self.outcomes["leftovers"] += 1
            self._expect(left, command, f"leftovers {hidden(folder)[:2]}", ended)

    def again(self, command: Command, folder: Path) -> None:
        """Run a killed command again: it must succeed, and remove what the killed run left."""
        out, words = folder / command.out, command.words
        if out.is_dir():
            if command.resumes:
                shutil.move(out, folder / "earlier")
                plain = words[: words.index("--resume")] if "--resume" in words else words
                words = (*plain, "--resume", "earlier")
            else:
                shutil.rmtree(out)
        had = hidden(folder)
        ended = run(words, folder, self.place / "log")
        self.outcomes["run again"] += 1
        self._expect(ended.code == 0, command, "the next run fails", ended)
        self._expect(not hidden(folder), command, "leftovers after the next run", ended)
        said = not had or "Removed" in ended.told
        self._expect(said, command, "leftovers removed without a word", ended)
        if ended.code == 0:
            command.check(out)

    def fill(self, command: Command, disk: Path | None) -> None:
        """Run a command on a disk that is full."""
        whole, draw = self.measure(command), self.generator
        kind = draw.randrange(3 if disk else 2)
        folder = self.fresh()
        moment = Moment(operation=draw.randint(1, whole.operations))
        if kind == 1:
            moment = Moment(file_limit=int(10 ** draw.uniform(1, 4.5)))
        if kind == 2 and disk is not None:
            moment = Moment()
            folder = self._on(disk, folder)
        ended = run(command.words, folder, self.place / "log", moment)
        self.outcomes[f"full disk: exit {ended.code}"] += 1
        self._expect(ended.code in (0, 2), command, "another exit code on a full disk", ended)
        self._expect("Traceback" not in ended.told, command, "a traceback on a full disk", ended)
        self.look(command, folder, ended, left=False)
        if kind == 2:
            shutil.rmtree(folder)

    def _on(self, disk: Path, folder: Path) -> Path:
        """Move a workspace to the small disk and leave it little space."""
        there = disk / "work"
        shutil.rmtree(there, ignore_errors=True)
        shutil.copytree(folder, there)
        (disk / "ballast").unlink(missing_ok=True)
        free = shutil.disk_usage(disk).free
        taken = max(0, free - 4096 * self.generator.randrange(0, 40))
        (disk / "ballast").write_bytes(b"\0" * taken)
        return there

    def _expect(self, good: bool, command: Command, what: str, ended: Ended) -> None:
        if not good:
            self._fail(command, what, ended)

    def _fail(self, command: Command, what: str, ended: Ended) -> None:
        told = ended.told[-600:]
        self.failures.append(
            {"command": command.name, "what": what, "exit": ended.code, "told": told}
        )


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of every file, by its path; temporary ones left out."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".tofcorr-" not in str(path)
    }


def hidden(folder: Path) -> list[str]:
    """Return the temporary files that a run left, also among the system's."""
    found = [path.name for path in folder.iterdir() if ".tofcorr-" in path.name]
    return found + [path.name for path in Path(tempfile.gettempdir()).glob("tofcorr-scratch-*")]


@contextmanager
def small_disk(place: Path) -> Iterator[Path | None]:
    """Mount a file system of 2 MB in memory; None where that is not allowed."""
    disk = place / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    done = subprocess.run(mount, capture_output=True, check=False)
    try:
        yield None if done.returncode else disk
    finally:
        if not done.returncode:
            subprocess.run(["umount", str(disk)], check=False)


@click.command()
@click.option("--kills", default=1000, show_default=True, help="Number of runs that are killed.")
@click.option("--full", default=150, show_default=True, help="Runs on a full disk.")
@click.option("--cuts", default=2000, show_default=True, help="Copies that are cut short.")
@click.option("--seed", default=1, show_default=True)
@click.option("--only", help="Commands whose name begins with this.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON of all failures.")
def main(kills: int, full: int, cuts: int, seed: int, only: str | None, out: Path | None) -> None:
    """Kill, look, run again; count."""
    with tempfile.TemporaryDirectory() as name:
        place, generator = Path(name), random.Random(seed)
        # Scratch folders of these runs, and of no others, are looked for.
        tempfile.tempdir = str(place / "scratch")
        (place / "scratch").mkdir()
        (place / "ready").mkdir()
        prepare(place / "ready", seed)
        among = [one for one in commands() if one.name.startswith(only or "")]
        trial = Trial(place / "ready", place, generator)
        for one in among:
            trial.measure(one)
        killed: Counter[str] = Counter()
        for number in tqdm(range(kills), unit="kill", disable=None):
            # Every command at least once.
            command = among[number] if number < len(among) else drawn(generator, among)
            killed[command.name] += 1
            trial.kill(command)
        quick = [one for one in among if trial.whole[one.name].seconds < 8]
        with small_disk(place) as disk:
            for _ in tqdm(range(full), unit="full disk", disable=None):
                trial.fill(drawn(generator, quick), disk)
        texts, binary = cut_copies(place / "ready", cuts, generator) if cuts else ([], [])
    _tell(trial, killed, (texts, binary), (kills, full, cuts, seed), out)


def _tell(
    trial: Trial,
    killed: Counter[str],
    cut: tuple[list[str], list[str]],
    asked: tuple[int, int, int, int],
    out: Path | None,
) -> None:
    for command, number in sorted(killed.items()):
        click.echo(f"{command:40} {number} killed")
    click.echo(", ".join(f"{name}: {number}" for name, number in sorted(trial.outcomes.items())))
    for failure in trial.failures[:30]:
        click.echo(json.dumps(failure))
    for sentence in (cut[0] + cut[1])[:20]:
        click.echo(sentence)
    kills, full, cuts, seed = asked
    click.echo(
        f"{kills} kills and {full} full disks over {len(killed)} commands, seed {seed}: failures "
        f"{len(trial.failures)}. {cuts} copies cut short: binary ones taken for whole "
        f"{len(cut[1])}, texts read as something else {len(cut[0])}."
    )
    if out is not None:
        values = {"outcomes": trial.outcomes, "failures": trial.failures, "cut": cut}
        out.write_text(json.dumps(values), encoding="utf-8")


if __name__ == "__main__":
    main()
