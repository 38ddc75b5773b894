"""Runs to which something happens, and what must be left of their files."""

import hashlib
import json
import os
import random
import shutil
import signal
import tempfile
from collections import Counter
from pathlib import Path

import click

from benchmarks.killing.commands import Command
from benchmarks.killing.runs import Ended, Moment, run

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
            # The first run warms the machine's caches; later ones take as long as the second.
            run(command.words, self.fresh(), self.place / "log")
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
        elif out.is_file() and not command.replaces:
            out.unlink()
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
        shown = max(0, ended.told.find("Traceback") - 300)
        told = ended.told[shown : shown + 1500] if shown else ended.told[-600:]
        found = {"command": command.name, "what": what, "exit": ended.code, "told": told}
        self.failures.append(found)
        click.echo(json.dumps(found))


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
