"""A fit starts without the libraries that are slow to import."""

import sys
from pathlib import Path

from running import printed


def test_a_fit_imports_neither_the_compiler_nor_scipy_stats_nor_matplotlib() -> None:
    code = "import sys, tofcorr.training.run, tofcorr.drift.check; print(*sys.modules)"
    loaded = printed(sys.executable, "-c", code, cwd=Path(__file__).parents[2]).split()
    assert not {"torch._dynamo", "scipy.stats", "scipy.optimize", "matplotlib"} & {*loaded}
