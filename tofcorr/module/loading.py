"""One call for every file of a corrector that this package writes."""

import zipfile
from importlib import import_module
from pathlib import Path

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.registry import FORMATS
from tofcorr.correction.loaded import LoadedCorrector
from tofcorr.correction.state import held_calibration
from tofcorr.errors import CalibrationDataError
from tofcorr.files import refuse_damaged

_WHAT = "a file of tofcorr train or export that corrects (.ts, .pt2, .onnx, .npz, .pt), or a run"


def load_corrector(path: Path | str, *, trust: bool = False) -> LoadedCorrector:
    """Load what corrects frames, of any format: `corrected, valid = corrector(depth, amplitude)`.

    How closely each agrees with the calibration in float64:

    - a run folder, its `state.pt`, a module's `.pt`, TorchScript (`.ts`): 1 um, all bit for bit;
    - a compiled package (`.pt2`), ONNX (`.onnx`): 1 um;
    - a look-up table (`.npz`): 0.1 mm.

    Beyond 1 m, by that share of the depth. Frames are those of the camera, float32, `(H, W)` or
    `(B, H, W)`, metres and the camera's amplitudes, as tensors or NumPy arrays; results have their
    shape. No return: NaN, not valid. Outside the calibrated range of distance or amplitude:
    corrected with the error at the range's edge, not valid. `corrector.metadata()` is JSON text:
    camera, depth kind, model, validity range, versions. Conditions such as
    `integration_time_us=800.0` follow the amplitude; `.pt2`, `.onnx` and `.npz` hold their mean.

    TorchScript and compiled packages are programs, and loading one runs it. Such a file is not run:
    the corrector is rebuilt from the calibration that it holds beside its code, or that stands
    beside it in a run folder. For the speed of a package, say `trust=True`.

    Args:
        path: A file that `tofcorr train`, `tofcorr export` or `DepthCorrection.save` wrote, or the
            folder of a run.
        trust: Whether to run the program that the file is, if it is one. Say so only of files whose
            origin you know.

    Returns:
        A module in `eval` mode on the CPU; `to` moves one that was rebuilt. For gradients use
        `tofcorr.DepthCorrection`.

    Raises:
        CalibrationDataError: There is no such file, it is damaged, or no corrector; it is a program
            that holds no calibration, and is not trusted; or the verdict of the run is
            `do not use`, and it was trained without `--force`.
        ConfigError: Its format needs a package that is not installed, or it is a TorchScript file
            to be trusted, where torch has no TorchScript.
    """
    path = Path(path)
    kind = _format_of(path)
    if kind is None:
        # Slow to import.
        from tofcorr.module.depth_correction import DepthCorrection
        from tofcorr.training.judgement import verdict_of_run

        verdict_of_run(path)
        state = DepthCorrection.load(path).to_state()
    elif trust or not FORMATS[kind].runs_code:
        module = import_module(f"tofcorr.correction.export.{kind}")
        return getattr(module, f"load_{kind}")(path)
    else:
        state = held_calibration(path)
    if state is None:
        raise CalibrationDataError(
            f"{path}: holds a program and no calibration, as files of older versions and of other "
            "programs do; loading it would run it. Export the run again, or say trust=True "
            "(--trust-model) if you know who wrote it."
        )
    corrector = DepthCorrector.from_state(state)
    return LoadedCorrector(corrector, corrector.metadata, path)


def _format_of(path: Path) -> str | None:
    """Return the name of the format of a file; None: a folder, a calibration or a module.

    Raises:
        CalibrationDataError: There is no such file, or it is damaged.
    """
    if path.is_dir():
        return None
    if path.suffix == FORMATS["onnx"].ending:  # No archive.
        return "onnx"
    refuse_damaged(path, _WHAT)
    with zipfile.ZipFile(path) as archive:
        names = "\n".join(archive.namelist())
    known = (one for one in FORMATS.values() if one.record and one.record in names)
    return next((one.name for one in known), None)
