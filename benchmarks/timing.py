"""Time jobs beside one another, so that their ratios hold on any machine."""

import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import ArrayLike

Seconds = dict[str, list[float]]
JSON = click.option("--json", "out", type=click.Path(path_type=Path), help="File for all figures.")


def timed(
    jobs: Mapping[str, Callable[[], object]],
    repeats: int,
    *,
    warm_up: int = 1,
    in_a_row: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> Seconds:
    """Return seconds of each job, taken in turn round after round: all see the same machine.

    Args:
        jobs: What is timed.
        repeats: Rounds.
        warm_up: Rounds before these.
        in_a_row: Calls of a job that count as one time, after one that takes the memory anew
            which other jobs gave back.
        clock: Seconds, of the wall or of the processor.
    """
    seconds: Seconds = {name: [] for name in jobs}
    for _ in range(warm_up + repeats):
        for name, job in jobs.items():
            for _ in range(in_a_row > 1):
                job()
            start = clock()
            for _ in range(in_a_row):
                job()
            seconds[name].append((clock() - start) / in_a_row)
    return {name: times[warm_up:] for name, times in seconds.items()}


def spread(values: ArrayLike) -> list[float]:
    """Return minimum, median and maximum."""
    return [float(f(np.asarray(values))) for f in (np.min, np.median, np.max)]


def machine() -> str:
    """Return processor and threads."""
    return f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"


def write(result: Mapping[str, Any] | Sequence[Any], out: Path | None) -> None:
    """Write all figures, if they are asked for."""
    if out:
        out.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
