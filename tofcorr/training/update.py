"""`tofcorr.update`: carry a calibration on with a few new frames, and say what has changed."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.correction.state import STATE_FILE, CalibrationState, load_calibration
from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import solvable
from tofcorr.fit.changes import Explanation, explain
from tofcorr.fit.fitting import calibrated
from tofcorr.fit.known import PriorKnowledge, known_of
from tofcorr.fit.problem import Fit
from tofcorr.fit.walls import walls_alone
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import (
    Dataset,
    PlaneChoice,
    Recordings,
    SplitOptions,
    hand_eye_is_free,
    resolved_planes,
    thread_number,
)
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.pool import CameraType, load_type
from tofcorr.training.run import Carried, TrainingResult, carried_training

_DEG = math.degrees(1)
# Keeps the direction of no change defined.
_TINY = torch.finfo(torch.float64).tiny


def update(
    run: Path | str,
    recordings: Recordings,
    *,
    out: Path | str | None = None,
    prior: Path | str | None = None,
    planes: PlaneChoice = "auto",
    figures: bool = True,
    force: bool = False,
) -> TrainingResult:
    """Carry a calibration on with new frames, and say which part of it has changed.

    The old calibration is the prior. How much each part may have changed is chosen by evidence:
    nothing; the mount was bumped; the camera is warmer or colder; both; or it is another camera of
    the type. All new frames are fitted, with the options of the run: ten of any wall are enough.

    Args:
        run: Folder of the old run.
        recordings: The new frames: a folder, a `Recording`, or several of either.
        out: Folder of the new run, as of `tofcorr.train`; None writes nothing.
        prior: File of `tofcorr.pool`: what other cameras of the type have in common; None: the
            errors of another camera may be any.
        planes: Whether the recorded planes of the new frames are right (`known`), only tell which
            frames show one wall (`unknown`), or as `recording.yaml` says (`auto`).
        figures: Whether the page is written.
        force: Go on whatever the recordings look like, and write a corrector whatever the verdict.

    Returns:
        The new run. Its report says under `update` what changed, by how much, and how probable the
        other explanations are.

    Raises:
        ConfigError: `prior` is of another model.
        CalibrationDataError: The frames are of another camera, or cannot be what they say; the run
            is no run, or its uncertainty is not known; or `out` exists.
    """
    folder = Path(run)
    state = load_calibration(folder / STATE_FILE)
    options = resolve_options(TrainingOptions, folder / "config.yaml")
    changes = {"planes": planes, "figures": figures, "model": state.error_model, "residual": None}
    options = options.model_copy(update=changes | {"split": SplitOptions(test_fraction=0.0)})
    of_type = None if prior is None else load_type(prior, options)
    carry = partial(_carried, folder, state, of_type)
    return carried_training(recordings, options, carry, out=out, force=force)


def _carried(
    run: Path,
    state: CalibrationState,
    of_type: CameraType | None,
    data: Dataset,
    options: TrainingOptions,
    frames: np.ndarray,
) -> Carried:
    """Return what is known under the most probable explanation of new frames."""
    camera, first = state.camera, data.first
    seen = (first.camera.width, first.camera.height), first.depth_kind
    if seen != ((camera.width, camera.height), state.depth_kind):
        expected = f"{camera.width}x{camera.height} pixels, {state.depth_kind} depth"
        said = f"this is not the camera that was calibrated: expected {expected}"
        raise CalibrationDataError(f"{first.path}: {said}, as in {run}.")
    moves = hand_eye_is_free(data, options.hand_eye) and state.hand_eye_estimated
    known, older = known_of(state, run, moves=moves)
    known, other = known.towards(covered_domain(data, frames, lattice_of(data, frames))), None
    if of_type is not None:
        domain = known.domain.joined(of_type.domain)
        known, other = known.on(domain), of_type.known(data).on(domain)
    if resolved_planes(options.planes, data.recordings) == "unknown":
        # Wherever walls were recorded: they are where the old calibration sees them.
        model = calibrated(ErrorModel(known.options, known.domain), known.parameters)
        data = walls_alone(data, frames, model).put_into(data)
    with solvable(first.path, "update"), thread_number(1):
        found = explain(data, frames, options, known, other)
    said = partial(update_report, run, known, found, older)
    units = {} if of_type is None else {"prior": {"units": list(of_type.units)}}
    return Carried(data, found[0].known, lambda fit: {"update": said(fit)} | units)


def update_report(
    run: Path, known: PriorKnowledge, found: Sequence[Explanation], older: str | None, fit: Fit
) -> dict[str, Any]:
    """Return what the report says of an update, plain values.

    Args:
        run: The old run.
        known: What it knew, on the ranges of the fit.
        found: The explanations of the new frames, the most probable first.
        older: What the old run lacks, one sentence; None: nothing.
        fit: The new fit.
    """
    best, moved = found[0], _moved(known, found[0], fit)
    return {
        "run": str(run.resolve()),
        "sentence": _sentence(best, moved),
        "explanations": [{"changed": one.name, "probability": one.probability} for one in found],
        "moved": moved,
        "notes": [] if older is None else [older],
    }


def _moved(known: PriorKnowledge, best: Explanation, fit: Fit) -> dict[str, Any]:
    """Return how far each part has moved, with one standard error.

    Of the step from the old estimate to the new one, that share is the change which its covariance
    has in what was believed of both.
    """
    step = known.parameters.step_to(fit.solution.parameters)
    gain = torch.linalg.solve(known.covariance + best.change, best.change).T
    change, covariance = gain @ step, gain @ fit.joint_covariance @ gain.T
    covariance = covariance + best.change - gain @ best.change
    moved: dict[str, Any] = {}
    if "mount" in best.parts:
        for name, part, unit in (("mount_mm", slice(0, 3), 1e3), ("mount_deg", slice(3, 6), _DEG)):
            moved |= {name: unit * float(change[part].norm())}
            along = change[part] / change[part].norm().clamp(min=_TINY)
            error = (along @ covariance[part, part] @ along).sqrt()
            moved |= {f"{name.replace('_', '_se_')}": unit * float(error)}
    if {"temperature", "camera"} & {*best.parts}:
        # Products of the functions, summed over all pixels: a ray has unit length.
        size, gram = len(fit.moments.symbols), fit.moments.gram.sum(dim=0)[3:-1, 3:-1]
        products = torch.einsum("iaja->ij", gram.view(size, 3, size, 3))
        own, weight = slice(len(step) - size, None), products[0, 0]
        mean, reads = products[0] / weight, change[own]
        square = reads @ products @ reads / weight
        lever = products @ reads / weight / square.sqrt().clamp(min=_TINY)
        moved |= {
            "reads_farther_mm": 1e3 * float(mean @ reads),
            "reads_farther_se_mm": 1e3 * float((mean @ covariance[own, own] @ mean).sqrt()),
            "correction_rms_mm": 1e3 * float(square.sqrt()),
            "correction_rms_se_mm": 1e3 * float((lever @ covariance[own, own] @ lever).sqrt()),
        }
    return moved


def _sentence(best: Explanation, moved: Mapping[str, float]) -> str:
    """Return what changed, by how much, and how probable that is."""

    def size(name: str, unit: str, places: int) -> str:
        quantity, of = name.rsplit("_", 1)
        return f"{moved[name]:.{places}f} ± {moved[f'{quantity}_se_{of}']:.{places}f} {unit}"

    mount = reads = differs = ""
    if "mount" in best.parts:
        mount = f"{size('mount_mm', 'mm', 1)} and {size('mount_deg', 'degrees', 2)}"
    if "reads_farther_mm" in moved:
        way = "farther" if moved["reads_farther_mm"] > 0 else "nearer"
        reads = f"it reads {size('reads_farther_mm', 'mm', 1).lstrip('-')} {way}"
        differs = f"its correction differs by {size('correction_rms_mm', 'mm', 1)} RMS"
    said = {
        "nothing": "Nothing changed: the calibration still holds",
        "mount": f"Only the mount moved: by {mount}; the camera measures as before",
        "temperature": f"Only the camera is warmer or colder: {reads}; the mount has not moved",
        "mount_and_temperature": f"The mount moved by {mount}, and the camera is warmer or colder: "
        f"{reads}",
        "camera": f"The camera is another one of its type: {differs}"
        f"{mount and f', and it is mounted {mount} away'}",
    }[best.name]
    return f"{said} (probability {best.probability:.2g})."
