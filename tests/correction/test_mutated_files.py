"""A calibration survives its file; one that was changed and saved again is refused in words.

Most of these once ended in a traceback, far from the file: `python -m benchmarks.fuzz` found them.
"""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import broken_recordings
import numpy as np
import pytest
import torch
from broken_recordings import GONE
from correction.export.states import ACCURACY, EYE_TO_HAND, TRANSFORMS, calibration, write

import tofcorr
from tofcorr.correction.lookup import read_lut
from tofcorr.correction.state import load_calibration, save_calibration
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import FrameNames
from tofcorr.module.loading import load_corrector

Change = Callable[[dict[str, Any]], Any]


def put(key: str, value: object) -> Change:
    """Return what replaces one entry."""
    return lambda values: broken_recordings.put(values, key, value)


NAN, MAP = float("nan"), torch.zeros(5, 7).double()
ENDLESS = [{"kind": "amplitude_polynomial", "degree": 10**9}]
STATES: dict[str, tuple[Change, str]] = {
    "no tensor": (put("coefficients", None), "'coefficients': .*Tensor"),
    "a list": (put("coefficients", lambda t: t.tolist()), "'coefficients': .*Tensor"),
    "an empty tensor": (put("coefficients", lambda t: t[:0]), r"shape \(10,\), got \(0,\)"),
    "too many": (put("coefficients", lambda t: t.repeat(2)), r"shape \(10,\), got \(20,\)"),
    "a matrix": (put("coefficients", lambda t: t[None]), r"expected shape \(10,\), got \(1, 10\)"),
    "float32": (put("coefficients", lambda t: t.float()), "expected a dense tensor of float64"),
    "complex": (put("coefficients", lambda t: t + 0j), "float64, got torch.complex128"),
    "sparse": (put("tool_from_camera", lambda t: t.to_sparse()), "a dense tensor of float64"),
    "NaN": (put("coefficients", lambda t: t * NAN), "'coefficients': expected finite numbers"),
    "huge": (put("coefficients", lambda t: t * 1e300), "expected numbers of at most 1e"),
    "no rotation": (put("tool_from_camera", lambda t: 2 * t), "A hand-eye transform: the last row"),
    "three rows": (put("tool_from_camera", lambda t: t[:3]), r"expected shape \(4, 4\)"),
    "a tensor for a version": (put("version", torch.ones(2)), "has version"),
    "a word for a version": (put("version", "x" * 3000), r"has version x+\.\.\., this package"),
    "no domain": (put("domain", GONE), "'domain' is missing"),
    "another size": (put("domain.height", 6), "'camera' and 'domain' disagree"),
    "too large a size": (put("domain.height", 10**7), "'domain.height': .*less than or equal"),
    "a range turned round": (put("domain.amplitude", (9.0, 1.0)), "'domain.amplitude': .*lower"),
    "a range of NaN": (put("domain.radial_distance", (NAN, 1.0)), "'domain.radial_distance.0'"),
    "an unknown condition": (put("domain.conditions", {"x": (0, 1, 2)}), "'x' is no condition"),
    "an unknown key": (put("colour", 1), "'colour' is not a known key"),
    # It took all memory.
    "an endless polynomial": (put("error_model.terms", ENDLESS), "degree': .*equal to 30"),
    "an unknown term": (put("error_model.terms", [{"kind": "x"}]), "'error_model.terms.0'"),
    "terms of another number": (put("error_model.terms", []), r"shape \(1,\), got \(10,\)"),
    "true for a size": (put("camera.width", True), "'camera.width': expected a number"),
    "a map without its term": (put("fixed_pattern", MAP), r"shape None, got \(5, 7\)"),
    "two noises": (put("noise", (1.0, 2.0)), "'noise.2' is missing|'noise'"),
    "a covariance of a row": (put("covariance", MAP[0]), r"expected shape \(10, 10\)"),
}


def test_a_calibration_survives_its_file_and_an_older_one_is_read(tmp_path: Path) -> None:
    accuracy = ACCURACY.model_copy(update={"undetermined": ("t_z and c0 together (corr +0.99)",)})
    changed = {"frames": EYE_TO_HAND, "hand_eye_accuracy": accuracy, "saturation_amplitude": 800.0}
    state = calibration(TRANSFORMS["general"], **changed)
    save_calibration(tmp_path / "state.pt", state)
    found = load_calibration(tmp_path / "state.pt")
    for name in type(state).model_fields:
        one, expected = getattr(found, name), getattr(state, name)
        same = torch.equal(one, expected) if isinstance(expected, torch.Tensor) else one == expected
        assert same, name
    values = torch.load(tmp_path / "state.pt", weights_only=True)
    del values["frames"], values["hand_eye_accuracy"]
    torch.save(values, tmp_path / "old.pt")
    old = load_calibration(tmp_path / "old.pt")
    assert (old.frames, old.hand_eye_accuracy) == (FrameNames(), None)


@pytest.mark.parametrize("name", STATES)
def test_a_changed_state_is_refused_by_key(tmp_path: Path, name: str) -> None:
    change, message = STATES[name]
    save_calibration(tmp_path / "state.pt", calibration(TRANSFORMS["general"]))
    values = torch.load(tmp_path / "state.pt", weights_only=True)
    change(values)
    torch.save(values, tmp_path / "changed.pt")
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        load_calibration(tmp_path / "changed.pt")
    assert str(refusal.value).startswith(f"{tmp_path / 'changed.pt'}")
    assert "\n" not in str(refusal.value)


MODULES: dict[str, tuple[Change, str]] = {
    "no state": (put("state", GONE), "'state' is missing"),
    "a number for a tensor": (put("state", {"error_model.constant": 1.0}), "'state.error_model"),
    "no labels": (put("state", lambda s: {"error_model.constant": s["_extra_state"]}), "damaged"),
    "a tensor for a format": (put("format", torch.ones(2)), "is not a calibration"),
    "a tensor for a version": (put("version", torch.ones(2)), "has version"),
    "noise of words": (put("noise", ("a", "b", "c")), "'noise.0'"),
    "frames of numbers": (put("frames", {"tool": 3}), "'frames.tool'"),
}


@pytest.fixture(scope="module")
def module_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("module")
    save_calibration(folder / "state.pt", calibration(TRANSFORMS["general"]))
    tofcorr.DepthCorrection.load(folder / "state.pt").save(folder / "module.pt")
    return folder / "module.pt"


@pytest.mark.parametrize("name", MODULES)
def test_a_changed_module_is_refused_by_key(tmp_path: Path, module_file: Path, name: str) -> None:
    change, message = MODULES[name]
    values = torch.load(module_file, weights_only=True)
    change(values)
    torch.save(values, tmp_path / "changed.pt")
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        tofcorr.DepthCorrection.load(tmp_path / "changed.pt")
    assert "\n" not in str(refusal.value)


def test_every_tensor_of_a_module_is_compared(tmp_path: Path, module_file: Path) -> None:
    values = torch.load(module_file, weights_only=True)
    for name in ("_extra_state", "hand_eye.twist", list(values["state"])[-1]):
        tensor = values["state"][name]
        for wrong in (torch.cat([tensor.reshape(-1)] * 2), tensor.double() * NAN):
            torch.save(values | {"state": values["state"] | {name: wrong}}, tmp_path / "changed.pt")
            with pytest.raises(CalibrationDataError, match=r"changed\.pt"):
                tofcorr.DepthCorrection.load(tmp_path / "changed.pt")


def test_a_corrector_with_one_changed_byte_is_refused(tmp_path: Path) -> None:
    # torch.jit.load reads it without a word, and corrects by other coefficients.
    state = calibration(TRANSFORMS["general"])
    path = tmp_path / "corrector.ts"
    write("torchscript", state, path)
    load_corrector(path)
    content = path.read_bytes()
    at = content.index(b"data/0") + 100
    path.write_bytes(content[:at] + bytes([content[at] ^ 64]) + content[at + 1 :])
    with pytest.raises(CalibrationDataError, match="is damaged; expected a file of tofcorr"):
        load_corrector(path)


def test_a_table_whose_arrays_or_metadata_were_changed_is_refused(tmp_path: Path) -> None:
    state = calibration(TRANSFORMS["general"], depth_kind="radial")
    write("lut", state, tmp_path / "whole.npz")
    read_lut(tmp_path / "whole.npz")
    with np.load(tmp_path / "whole.npz") as file:
        arrays = dict(file)
    metadata = json.loads(str(arrays["metadata"]))
    unsealed, older = (metadata | {"lut": {"format": "tofcorr-lut", "version": v}} for v in (1, 0))
    cases = [
        (arrays | {"offset": arrays["offset"] + np.float32(1e-3)}, "were changed after"),
        (arrays | {"metadata": np.array(json.dumps(older))}, "metadata: 'lut.version'"),
        (arrays | {"metadata": np.array("[]")}, "should be a valid dictionary"),
        (arrays | {"metadata": np.array(json.dumps(metadata | {"validity": 3}))}, "'validity'"),
        (arrays | {"metadata": np.array(json.dumps(unsealed)), "table": np.ones(3)}, "is damaged"),
        (arrays | {"metadata": np.array(json.dumps(unsealed)), "offset": np.ones(0)}, "is damaged"),
        ({name: one for name, one in arrays.items() if name != "table"}, "is not a look-up table"),
    ]
    for changed, message in cases:
        written = io.BytesIO()
        np.savez(written, **changed)
        (tmp_path / "changed.npz").write_bytes(written.getvalue())
        with pytest.raises(CalibrationDataError, match=message):
            read_lut(tmp_path / "changed.npz")
    (tmp_path / "text.npz").write_text("not a table")
    for name, message in (("text", "is not a look-up table"), ("none", "there is no such file")):
        with pytest.raises(CalibrationDataError, match=rf"{name}\.npz: {message}"):
            read_lut(tmp_path / f"{name}.npz")
