"""The corrector as a look-up table in an NPZ file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.frame_correction import signal_error
from tofcorr.correction.lookup import FORMAT, VERSION, LookupTable, digest_of, interpolate, read_lut
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.domain import Interval
from tofcorr.errors import ConfigError
from tofcorr.files.staged import staged_file

TOLERANCE = 1e-4
"""How far the interpolated table may be from the model, metres. Set by hand: a tenth of the 1 mm
that a good calibration leaves."""

# The table is refined until its error between the nodes is below this share of the tolerance (no
# unit). Set by hand: rounding to float32, and points that were not probed, need less than the rest.
_SHARE = 0.25
# Nodes along each axis that are tried, each twice as fine as the one before: linear interpolation
# then errs a quarter as much. Set by hand: the largest table has 17 MB.
_NODES = (65, 129, 257, 513, 1025, 2049)
# Random points at which table and model are compared. Set by hand.
_NUM_PROBES = 50_000
_NO_RANGE = Interval(0.0, 0.0)


def export_lut(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Tabulate the model, compare the table with it, and move it into place.

    The NPZ holds `offset` (H, W), `table` (R, A) over equally spaced distances and amplitudes,
    `radial_of_z` and `metadata`; `tofcorr.correction.lookup` reads it.

    Args:
        corrector: Where the metadata come from.
        path: The file to write; an older one is replaced.
        reference: The calibration that is tabulated.

    Raises:
        ConfigError: The model has a residual network, which no such table can hold.
        ExportError: The table differs from the model by more than `TOLERANCE`; nothing is written.
    """
    if reference.residual is not None:
        raise ConfigError(
            f"The model {reference.name} has a residual network, a function of distance, "
            "amplitude, row and column at once: a look-up table cannot hold it. Export "
            "torchscript, pt2 or onnx instead."
        )
    metadata = json.loads(corrector.metadata())
    arrays = {
        "offset": reference.model().error.pixel_error().detach().numpy().astype(np.float32),
        "table": _tabulate(reference).astype(np.float32),
        "radial_of_z": corrector.radial_of_z.cpu().numpy(),
    }
    metadata["lut"] = {"format": FORMAT, "version": VERSION, "sha256": digest_of(arrays)}
    with staged_file(path) as part:
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays, metadata=np.array(json.dumps(metadata)))
        require_parity(_on_tensors(read_lut(part)), reference, TOLERANCE)


def _tabulate(state: CalibrationState) -> np.ndarray:
    """Return the error over distance and amplitude, shape (R, A), refined until accurate."""
    reference = state.correction()
    error, limits = reference.error_model, reference.error_model.limits(state.domain)
    ranges = [limits.radial_distance, limits.amplitude or _NO_RANGE]
    if not error.needs_amplitude():
        ranges[1] = _NO_RANGE

    @torch.no_grad()
    def exact(places: Tensor) -> np.ndarray:
        """Return the error at places (2, ...) of the unit square over both ranges."""
        at = [low + (high - low) * u for (low, high), u in zip(ranges, places, strict=True)]
        return signal_error(error, *at, reference.ranges.normalised_amplitude).numpy()

    probes = torch.rand(2, _NUM_PROBES, generator=torch.Generator().manual_seed(0)).double()
    table, wanted = np.zeros((1, 1)), exact(probes)
    for nodes in _NODES:
        grid = torch.linspace(0, 1, nodes, dtype=torch.float64)
        columns = grid if error.needs_amplitude() else grid[:1]
        table = exact(torch.stack(torch.meshgrid(grid, columns, indexing="ij")))
        found = interpolate(table, *(probes.numpy()))
        if np.abs(found - wanted).max() < _SHARE * TOLERANCE:
            break
    return table


def _on_tensors(table: LookupTable) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        corrected, valid = table(depth.numpy(), amplitude.numpy())
        return torch.from_numpy(corrected), torch.from_numpy(valid)

    return correct
