"""A fit starts without the libraries that are slow to import."""

import subprocess
import sys
from pathlib import Path


def test_a_fit_imports_neither_the_compiler_nor_scipy_stats_nor_matplotlib() -> None:
    code = (
        "import sys; import tofcorr.training.run, tofcorr.drift.check; "
        "slow = {'torch._dynamo', 'scipy.stats', 'scipy.optimize', 'matplotlib'}; "
        "slow &= set(sys.modules); "
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
