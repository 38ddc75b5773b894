"""How many threads the program runs, and how they wait: set before torch is loaded."""

import math
import os
from collections.abc import MutableMapping
from pathlib import Path

# What a user may have set to say how threads wait; each then stands as it is.
_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
_NUMBER = "OMP_NUM_THREADS"
# Threads of NumPy's own matrix products.
_OF_NUMPY = "OPENBLAS_NUM_THREADS"
_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def set_up_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let waiting threads sleep, and start no more of them than there are cores to run on.

    OpenMP's threads otherwise spin while they wait for the next task. Beside other busy processes
    they then hold the cores that the task needs: one addition of a frame took 11 ms in place of
    0.8 ms. And torch counts the cores of the machine, where a container may use only some of them.
    NumPy's products run in one thread each: the program's own threads share them out. What the user
    has set in the environment is kept.

    Args:
        environment: Where to set the variables; torch reads those of the process when it is loaded.
    """
    if not any(name in environment for name in _WAITING):
        environment["OMP_WAIT_POLICY"] = "passive"
    environment.setdefault(_OF_NUMPY, "1")
    quota = core_quota()
    if _NUMBER not in environment and quota is not None and quota < _visible_cores():
        environment[_NUMBER] = str(max(1, math.floor(quota)))


def core_quota(path: Path = _QUOTA) -> float | None:
    """Return how many cores the container may use at once; None without a limit.

    Args:
        path: The file in which Linux states it: microseconds of use, and of the period.
    """
    try:
        used, period = path.read_text(encoding="ascii").split()
        return int(used) / int(period)
    except (OSError, ValueError):  # Another system, or "max": no limit.
        return None


def _visible_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
