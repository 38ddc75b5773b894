"""The corrector as a look-up table in an NPZ file."""

import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.correction.loaded import LoadedCorrector
from tofcorr.correction.lookup import FORMAT, digest_of, interpolate, read_lut
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING, Interval
from tofcorr.errors import ConfigError
from tofcorr.files import staged_file

TOLERANCE = 1e-4
"""How far the interpolated table may be from the model, metres. Set by hand: a tenth of the 1 mm
that a good calibration leaves."""


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
        raise ConfigError(f"{reference.name}'s network needs torchscript, pt2 or onnx.")
    metadata = json.loads(corrector.metadata())
    arrays = {
        "offset": reference.model().error.pixel_error().detach().numpy().astype(np.float32),
        "table": _tabulate(reference).astype(np.float32),
        "radial_of_z": corrector.radial_of_z.cpu().numpy(),
    }
    metadata["lut"] = {"format": FORMAT, "version": 1, "sha256": digest_of(arrays)}
    with staged_file(path) as part:
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays, metadata=np.array(json.dumps(metadata)))
        require_parity(load_lut(part), reference, TOLERANCE)


def load_lut(path: Path | str) -> LoadedCorrector:
    """Load a table for tensors on any device; `read_lut` reads it for NumPy.

    Raises:
        CalibrationDataError: There is no such file, or it is not such a table.
    """
    table = read_lut(path)

    def correct(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        found = table(depth.cpu().numpy(), amplitude.cpu().numpy())
        corrected, valid = (torch.from_numpy(one).to(depth.device) for one in found)
        return corrected, valid

    return LoadedCorrector(correct, lambda: json.dumps(table.metadata), path)


def _tabulate(state: CalibrationState) -> np.ndarray:
    """Return the error over distance and amplitude, shape (R, A), refined until accurate."""
    reference = state.correction()
    error, limits = reference.error_model, reference.error_model.limits(state.domain)
    ranges = [limits.radial_distance, limits.amplitude or EVERYTHING]
    if not error.needs_amplitude():
        ranges[1] = Interval(0.0, 0.0)

    @torch.no_grad()
    def exact(places: Tensor) -> np.ndarray:
        """Return the error at places (2, ...) of the unit square over both ranges."""
        distance, amplitude = (
            low + (high - low) * u for (low, high), u in zip(ranges, places, strict=True)
        )
        bounds = reference.ranges.normalised_amplitude.unbind()
        return error.signal_error(distance, amplitude, bounds).numpy()

    probes = torch.rand(2, 50_000, generator=torch.Generator().manual_seed(0)).double()
    table, wanted = np.zeros((1, 1)), exact(probes)
    # Twice as fine each time: linear interpolation then errs a quarter as much. The largest table
    # has 17 MB. Rounding to float32, and points that were not probed, need less than the rest of
    # the tolerance.
    for nodes in (2**k + 1 for k in range(6, 12)):
        grid = torch.linspace(0, 1, nodes, dtype=torch.float64)
        columns = grid if error.needs_amplitude() else grid[:1]
        table = exact(torch.stack(torch.meshgrid(grid, columns, indexing="ij")))
        found = interpolate(table, *(probes.numpy()))
        if np.abs(found - wanted).max() < TOLERANCE / 4:
            break
    return table
