"""Two processes give what one gives; whatever becomes of the copy, nothing is lost."""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tofcorr.pixels.thread_number import thread_number
from tofcorr.pixels.two_at_once import all_at_once, two_processes
from tofcorr.progress import LOG, stages, through

pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux copies safely"),
    pytest.mark.usefixtures("two_cores"),
]


Together = Callable[..., tuple[Any, Any]]


@pytest.fixture
def together(tmp_path: Path) -> Together:
    """Do one piece of work in the program and one in the copy, each when both have taken one."""
    program, meetings = os.getpid(), count()

    def run(
        first: Callable[[], object], second: Callable[[], object], about: Sequence[str] = ()
    ) -> tuple[Any, Any]:
        meeting = tmp_path / f"meeting {next(meetings)}"
        meeting.mkdir(exist_ok=True)

        def piece() -> tuple[bool, object]:
            (meeting / str(os.getpid())).touch()
            for _ in range(1000):
                if len(list(meeting.iterdir())) == 2:
                    break
                time.sleep(0.01)
            is_program = os.getpid() == program
            return is_program, (first if is_program else second)()

        found = dict(all_at_once([piece, piece], about))
        return found[True], found[False]

    return run


def is_gone(process: int) -> bool:
    """Whether a process has ended within a second, but for its entry in the table."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rsplit(")", 1)[1]
        except OSError:
            return True
        if state.split()[0] in "ZX":
            return True
        time.sleep(0.01)
    return False


def test_each_process_does_its_part_and_both_know_both_results(together: Together) -> None:
    with two_processes(True):
        pairs = [together(os.getpid, os.getpid) for _ in range(3)]
        large = together(lambda: torch.ones(10**6), lambda: torch.zeros(10**6))
    assert {first for first, _ in pairs} == {os.getpid()}
    assert len({second for _, second in pairs} - {os.getpid()}) == 1
    assert float(large[0].sum()) == 10**6
    assert float(large[1].sum()) == 0
    assert is_gone(pairs[0][1])


def test_pieces_are_shared_out_and_each_is_done_by_one_process(tmp_path: Path) -> None:
    def piece(number: int) -> tuple[int, int]:
        (tmp_path / f"{number} by {os.getpid()}").touch()
        for _ in range(1000):  # Until both processes have one.
            if len({path.name.split()[-1] for path in tmp_path.iterdir()}) == 2:
                break
            time.sleep(0.01)
        return number, os.getpid()

    with two_processes(True):
        found = [all_at_once([partial(piece, 10 * k + n) for n in range(5)]) for k in range(3)]
    assert [[number for number, _ in part] for part in found] == [
        [10 * k + n for n in range(5)] for k in range(3)
    ]
    assert len({process for _, process in found[0]}) == 2
    assert len(list(tmp_path.iterdir())) == 15


def test_what_both_share_is_not_sent_and_stays_the_same_object(together: Together) -> None:
    shared, own = torch.ones(10**6), torch.ones(3)
    with two_processes(True, (shared,)):
        first, second = together(lambda: [shared, own], lambda: [shared, own])
    assert first[0] is second[0] is shared
    assert torch.equal(first[1], own)
    assert (first[1] is own) != (second[1] is own)


def test_pieces_that_a_killed_copy_had_taken_are_done_by_the_program() -> None:
    program = os.getpid()

    def killed() -> int:
        if os.getpid() != program:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.02)
        return os.getpid()

    with two_processes(True):
        assert all_at_once([killed] * 4) == [program] * 4
        assert all_at_once([os.getpid] * 2) == [program] * 2


def test_what_is_shared_within_a_part_is_done_by_the_process_that_has_the_part(
    together: Together,
) -> None:
    def within() -> list[int]:
        return all_at_once([os.getpid] * 2)

    with two_processes(True):
        first, second = together(within, within)
    assert first == [os.getpid()] * 2
    assert second[0] == second[1] != os.getpid()


def test_outside_the_block_and_where_no_copy_is_allowed_one_process_does_all() -> None:
    assert all_at_once([os.getpid] * 2) == [os.getpid()] * 2
    with two_processes(False):
        assert all_at_once([os.getpid] * 2) == [os.getpid()] * 2


@pytest.mark.parametrize("why", ["one core", "shared operations", "another system"])
def test_no_copy_is_made_where_it_would_gain_nothing_or_not_be_safe(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = 1
    if why == "one core":
        monkeypatch.setattr("tofcorr.pixels.copied_process.threads_at_once", lambda: 1)
    elif why == "shared operations":
        threads = 2
    else:
        monkeypatch.setattr(sys, "platform", "darwin")
    with thread_number(threads), two_processes(True):
        assert all_at_once([os.getpid] * 2) == [os.getpid()] * 2


def test_without_memory_for_a_copy_one_process_does_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> int:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(os, "fork", fail)
    with two_processes(True):
        assert all_at_once([os.getpid] * 2) == [os.getpid()] * 2


def test_an_error_of_a_piece_is_an_error_of_the_program_whoever_took_it(tmp_path: Path) -> None:
    def fail() -> None:
        (tmp_path / str(os.getpid())).touch()
        time.sleep(0.1)  # So that the copy takes the other one.
        raise ValueError("the second")

    with pytest.raises(ValueError, match="the second"), two_processes(True):
        all_at_once([fail, fail])
    assert (tmp_path / str(os.getpid())).exists()


def test_an_interruption_of_the_program_ends_the_copy(together: Together, tmp_path: Path) -> None:
    program, noted = os.getpid(), tmp_path / "copy"

    def second() -> None:
        noted.write_text(str(os.getpid()))

    def interrupted() -> None:
        together(lambda: 1, second)
        if os.getpid() == program:
            raise KeyboardInterrupt
        time.sleep(60)

    with pytest.raises(KeyboardInterrupt), two_processes(True):
        interrupted()
    assert is_gone(int(noted.read_text()))


def test_a_killed_program_takes_its_copy_along(tmp_path: Path) -> None:
    noted = tmp_path / "copy"
    program = os.fork()
    if not program:
        program = os.getpid()
        with two_processes(True):
            if os.getpid() != program:
                noted.write_text(str(os.getpid()))
                time.sleep(60)
            while not (noted.exists() and noted.read_text()):
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGKILL)
        os._exit(0)
    _, status = os.waitpid(program, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert is_gone(int(noted.read_text()))


def test_where_memory_runs_out_the_copy_goes_first(together: Together) -> None:
    def willing() -> int:
        return int(Path("/proc/self/oom_score_adj").read_text(encoding="ascii"))

    before = willing()
    with two_processes(True):
        assert together(willing, willing) == (before, 1000)


def test_processes_that_went_different_ways_take_no_results_of_one_another() -> None:
    with two_processes(True):
        found = all_at_once([os.getpid] * 4, about=[str(os.getpid())])
    assert found == [os.getpid()] * 4


def test_the_copy_draws_nothing_at_the_terminal(
    together: Together, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "terminal").open("w") as terminal:
        monkeypatch.setattr(sys, "stderr", SimpleNamespace(isatty=lambda: True))
        sys.stderr.write, sys.stderr.flush = terminal.write, terminal.flush
        with stages("work", 3) as begin:
            begin("together")
            with two_processes(True):
                together(lambda: begin("program"), lambda: begin("copy"))
                together(lambda: 1, lambda: list(through(range(3), "bar of the copy")))
    drawn = (tmp_path / "terminal").read_text()
    assert "together" in drawn
    assert "program" in drawn
    assert "copy" not in drawn


def test_every_step_is_logged_once(
    together: Together, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handler = logging.FileHandler(tmp_path / "log")
    monkeypatch.setattr(LOG, "handlers", [handler])
    level = LOG.level
    LOG.setLevel(logging.INFO)
    try:
        with two_processes(True):
            LOG.info("both")
            together(lambda: LOG.info("first"), lambda: LOG.info("second"))
            LOG.info("both again")
    finally:
        LOG.setLevel(level)
        handler.close()
    lines = (tmp_path / "log").read_text().split("\n")
    assert sorted(lines) == ["", "both", "both again", "first", "second"]
