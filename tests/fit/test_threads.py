"""A fit lets one thread do each of its small operations, and shares out the pass over pixels."""

from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import EA, simulated_wall

from tofcorr.estimation.solvers import Solution
from tofcorr.fit.fitting import fit
from tofcorr.pixels import lattice as lattice_module
from tofcorr.pixels.dataset import threads_at_once
from tofcorr.pixels.lattice import covered_domain
from tofcorr.training.calibration import TrainingOptions


def test_solver_and_pass_each_use_threads_as_they_should(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside busy processes the solver took ten times as long with two threads as with one."""
    data = simulated_wall(tmp_path / "wall", shots=(("white", 12),))
    frames = np.arange(data.num_frames)
    options = TrainingOptions.from_mapping({"name": "EA", "model": EA}, "test")
    of_pass: list[int] = []
    of_solver: list[int] = []
    in_threads = lattice_module.in_threads

    def watched(work: object, items: object, threads: int | None = None) -> object:
        of_pass.append(threads or threads_at_once())
        return in_threads(work, items, threads)  # type: ignore[arg-type]

    def watcher(_: Solution) -> None:
        of_solver.append(torch.get_num_threads())

    monkeypatch.setattr(lattice_module, "in_threads", watched)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        fit(data, frames, options, covered_domain(data, frames), watcher)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert set(of_pass) == {2}
    assert set(of_solver) == {1}
