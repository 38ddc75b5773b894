"""`tofcorr train --with`: what a diagnosis named becomes part of the model, where that helps.

A diagnosis says which effect a simulator lacks. Some effects are errors of a pixel that its own
depth, amplitude, place or the frame's conditions tell: an error term undoes them. A clock that is
off moves the recorded poses. Each is tried in turn, on poses held out of the half that is fitted,
and kept where these are predicted significantly better. What else there is no single frame tells.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from tofcorr.comparison.experiment import ModelFitter, without_frames
from tofcorr.comparison.options import DECIDED_BY_THE_COMPARISON, ComparedModel, SelectionOptions
from tofcorr.comparison.select import errors_by_pose
from tofcorr.comparison.statistics import Estimate
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.registry import TERMS
from tofcorr.errors import CalibrationDataError
from tofcorr.files import reading
from tofcorr.geometry.se3 import small_motion, tool_twists
from tofcorr.options import Options, resolve_options
from tofcorr.pixels.dataset import Dataset, Recordings, folds, opened
from tofcorr.pixels.passes import FrameErrors, held_out_errors
from tofcorr.pixels.sample import MaskOptions
from tofcorr.scene_light.flying import FlyingPixelsOptions
from tofcorr.scene_light.stray import StrayLightState
from tofcorr.training.calibration import TrainingOptions, halves
from tofcorr.training.run import Carried, Config, TrainingResult, carried_training, inspected
from tofcorr.training.scene import SecondBouncesWanted

# The kind of term that undoes an effect. The first three effects are finer forms of a polynomial:
# its degree is raised.
_POLYNOMIALS = ("distance", "pixel", "amplitude")
_CONDITIONS = ("integration_time", "room_temperature", "warm_up", "ambient_light")
_TERM_OF = {
    **{name: f"{name}_polynomial" for name in _POLYNOMIALS},
    **{name: name for name in (*_CONDITIONS, "fixed_pattern")},
    "row_column_pattern": "fixed_pattern",
    "wiggling": "periodic",
}
_CLOCK = "timestamp_offset"
_STRAY = "stray_light"
_MIXED = "mixed_pixels"
_MULTIPATH = "multipath"


@dataclass(frozen=True)
class Tried:
    """What became of an effect that a diagnosis named.

    Attributes:
        effect: Its name.
        kept: Whether it is part of the calibration.
        why: Why, in words.
        without_mm: Mean absolute held-out error without it, millimetres; None: it was not tried.
        with_mm: The same with it.
        p_value: That of no difference between them; None: it was not tried.
    """

    effect: str
    kept: bool
    why: str
    without_mm: float | None = None
    with_mm: float | None = None
    p_value: float | None = None

    @property
    def sentence(self) -> str:
        """What became of it, in one sentence."""
        return f"{self.effect} is {'corrected' if self.kept else 'left out'}: {self.why}."


class _Model(NamedTuple):
    """The recordings, with poses as they are believed, and what is fitted to them.

    Attributes:
        data: The recordings.
        options: Of the fit.
        error: Of each pose on images that were not fitted, mm; None: it was not measured.
    """

    data: Dataset
    options: TrainingOptions
    error: np.ndarray | None = None


def train_with(
    diagnosis: Path | str,
    recordings: Recordings,
    config: Config = "ea",
    *,
    out: Path | str | None = None,
    force: bool = False,
) -> TrainingResult:
    """Train, and correct what a diagnosis named where that predicts held-out images better.

    Args:
        diagnosis: Folder that `tofcorr diagnose` wrote, or its `diagnosis.json`.
        recordings: As of `tofcorr.train`: those that were diagnosed, or others of the camera.
        config: The model to start from, as of `tofcorr.train`.
        out: As of `tofcorr.train`.
        force: As of `tofcorr.train`.

    Returns:
        The run. Its report says under `named` what became of each effect, and why.

    Raises:
        ConfigError: The configuration is wrong.
        CalibrationDataError: `diagnosis` holds none, or as of `tofcorr.train`.
    """
    found, options = _read(Path(diagnosis)), resolve_options(TrainingOptions, config)
    named = dict.fromkeys(name for members in found["cause_sets"] for name in members)
    data, said = Dataset(opened(recordings)), list[Tried]()
    data = data.without_stray_light(options.runtime.stray_light)
    if named:
        usable, chosen, _, left_out = inspected(data, options, force=force)
        held_out = np.setdiff1d(np.arange(data.num_frames), halves(usable, chosen, left_out)[0])
        best = _Model(data, chosen)
        for effect in named:
            best, tried = _tried(best, effect, found, data, held_out)
            said.append(tried)
        kept = {"model": best.options.model, "runtime": best.options.runtime}
        data, options = best.data, options.model_copy(update=kept)

    def carry(data: Dataset, options: TrainingOptions, frames: np.ndarray) -> Carried:
        del options, frames
        words = [one.sentence for one in said] or ["The diagnosis names no effect."]
        report = {"diagnosis": str(diagnosis), "effects": [asdict(one) for one in said]}
        return Carried(data, None, lambda fit: {"named": report | {"sentences": words}})

    return carried_training(data.recordings, options, carry, out=out, force=force)


def _read(path: Path) -> Mapping[str, Any]:
    """Return the content of a diagnosis.

    Raises:
        CalibrationDataError: There is none.
    """
    file = path / "diagnosis.json" if path.is_dir() else path
    with reading(file):
        content = file.read_bytes()
    try:
        found = json.loads(content)
        if found["format"] == "tofcorr-diagnosis":
            return found
    except (ValueError, TypeError, KeyError):
        pass
    said = "expected a folder that tofcorr diagnose wrote, or its diagnosis.json"
    raise CalibrationDataError(f"{file}: {said}.")


def _tried(
    best: _Model,
    effect: str,
    found: Mapping[str, Any],
    recorded: Dataset,
    left_out: np.ndarray,
) -> tuple[_Model, Tried]:
    """Return the better of the models without and with an effect, and what was found.

    Args:
        best: The model so far.
        effect: The effect's name.
        found: The diagnosis.
        recorded: The recordings as given, which say what a pose is.
        left_out: Global numbers of the frames that take no part.
    """
    removed = _removed_in_frames(effect, found)
    if removed is not None:
        runtime = best.options.runtime.model_copy(update=removed[0])
        options = best.options.model_copy(update={"runtime": runtime})
        return best._replace(options=options), Tried(effect, kept=True, why=removed[1])
    further = _with_effect(best, effect, found)
    if isinstance(further, str):
        return best, Tried(effect, kept=False, why=further)
    comparison = SelectionOptions(models=(ComparedModel(name="any"),))
    drawn = enumerate(folds(recorded, comparison.folds, comparison.seed))
    tests = list(without_frames({str(k): test for k, test in drawn}, left_out.tolist()).values())
    try:
        before = best.error
        if before is None:
            before = _held_out_error(best, recorded, tests, left_out)
        after = _held_out_error(further, recorded, tests, left_out)
    except CalibrationDataError as error:  # Such as a condition that was not recorded.
        return best, Tried(effect, kept=False, why=str(error).removesuffix("."))
    without, better = float(before.mean()), float(after.mean())
    # As `Ranking` compares models: folds share most of their poses.
    overlap = len(tests) / (len(tests) - 1) / len(before)
    change = Estimate(after - before, overlap)
    kept = change.significant and change.mean < 0
    why = f"held-out images are off by {without:.2f} mm without and by {better:.2f} mm with it"
    why += "" if kept else ", which is not significantly better"
    tried = Tried(effect, kept, why, without, better, change.p_value)
    return (further._replace(error=after) if kept else best._replace(error=before)), tried


def _removed_in_frames(
    effect: str, found: Mapping[str, Any]
) -> tuple[dict[str, Options], str] | None:
    """Return what the corrector is to look for in a frame, and why; None: nothing."""
    if effect == _MIXED:
        why = "the corrector looks for pixels that mix two surfaces"
        return {"flying_pixels": FlyingPixelsOptions()}, why
    state = found.get("second_bounces")
    if effect != _MULTIPATH or state is None:
        return None
    wanted = SecondBouncesWanted(**{k: v for k, v in state.items() if k != "gain_interval"})
    return {"second_bounces": wanted}, "the corrector removes second bounces of light in a frame"


def _with_effect(best: _Model, effect: str, found: Mapping[str, Any]) -> _Model | str:
    """Return the model that undoes an effect as well, or why there is none."""
    data, options = best.data, best.options
    values = {one["name"]: one["value"] for one in found["fitted"] if one["cause"] == effect}
    if effect in (_CLOCK, _STRAY) and not values:
        return "it is one of several that may be there, and the diagnosis fitted another one"
    if effect == _CLOCK:
        return best._replace(data=_at_the_images_time(data, values))
    if effect == _STRAY:
        stray = _stray_light(data, values)
        runtime = options.runtime.model_copy(update={"stray_light": stray})
        options = options.model_copy(update={"runtime": runtime})
        return _Model(data.without_stray_light(stray), options)
    if effect not in _TERM_OF:
        return "no single frame tells it, so no corrector can undo it"
    kind, finer = TERMS[_TERM_OF[effect]], effect in _POLYNOMIALS
    there = [term for term in options.model.terms if isinstance(term, kind)]
    if there and not finer:
        return "the model has a term of it already"
    terms = [
        term.model_copy(update={"degree": getattr(term, "degree", 0) + 2})
        if term in there
        else term
        for term in options.model.terms
    ]
    model = ErrorModelOptions(terms=(*terms, *([] if there else [kind(kind=_TERM_OF[effect])])))
    return best._replace(options=options.model_copy(update={"model": model}))


def _at_the_images_time(data: Dataset, values: Mapping[str, float]) -> Dataset:
    """Return the recordings with the poses of the time at which the images were taken.

    Args:
        data: The recordings.
        values: What the diagnosis found: by how much images are later than their poses and half of
            its drift over the recording, seconds, and the exposures that a frame takes.
    """
    moved = []
    for recording in data.recordings:
        table = recording.frames
        time, pose = torch.from_numpy(table.timestamp), torch.from_numpy(table.world_from_tool)
        first, last = float(time.min()), float(time.max())
        drift = (2 * time - first - last) / ((last - first) or 1.0)
        late = values["offset_s"] + values["half_of_drift_s"] * drift
        if "exposures" in values:
            exposure = recording.require("integration_time", _CLOCK)
            late = late + values["exposures"] * torch.from_numpy(exposure)
        twist = tool_twists(time, pose).nan_to_num(0.0)
        moved.append((pose @ small_motion(twist * late[:, None])).numpy())
    return data.with_columns(world_from_tool=np.concatenate(moved))


def _stray_light(data: Dataset, values: Mapping[str, float]) -> StrayLightState:
    """Return the stray light that a diagnosis found; its names say where it goes."""
    ways = {kind: [name for name in values if name.startswith(kind)] for kind in ("share", "ghost")}
    sizes = {kind: tuple(float(name.split("_")[1]) for name in own) for kind, own in ways.items()}
    shares = {kind: tuple(values[name] for name in own) for kind, own in ways.items()}
    return StrayLightState(
        modulation_frequency=data.first.require("modulation_frequency", _STRAY),
        sigma_of_width=sizes["share"],
        shares=shares["share"],
        veil=values["veil"],
        ghost_sizes=sizes["ghost"],
        ghost_shares=shares["ghost"],
    )


def _held_out_error(
    model: _Model, recorded: Dataset, tests: list[np.ndarray], left_out: np.ndarray
) -> np.ndarray:
    """Return the error of each pose on images that were not fitted, mm.

    Args:
        model: What is fitted.
        recorded: The recordings as given, which say what a pose is.
        tests: Global numbers of the frames held out in turn.
        left_out: Global numbers of the frames that take no part.
    """
    own = {name: getattr(model.options, name) for name in model.options.model_fields_set}
    compared = ComparedModel(**{k: v for k, v in own.items() if k not in DECIDED_BY_THE_COMPARISON})
    masks = {name: own[name] for name in MaskOptions.model_fields if name in own}
    options = SelectionOptions(models=(compared,), planes=model.options.planes, **masks)
    options = options.for_recordings(model.data.recordings)
    fitter = ModelFitter(model.data, options, left_out.tolist())
    fits = [fitter.fit(compared, np.setdiff1d(fitter.frames, test), test) for test in tests]
    parts = [vars(own["to_plane"]) for own in held_out_errors(fitter.measured, fits)]
    joined = {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}
    return errors_by_pose(recorded, FrameErrors(**joined), options)
