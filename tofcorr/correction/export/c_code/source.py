"""Writes the corrector as C source: header, source and test program, from templates."""

import re
from collections.abc import Iterable
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, FunctionLoader, StrictUndefined

from tofcorr.correction.corrector import (
    RuntimeErrorModel,
    RuntimePolynomial,
    separated,
    summed_polynomials,
)
from tofcorr.correction.export.c_code.pieces import Pieces, pieces_of
from tofcorr.correction.export.parity import probe_frames
from tofcorr.correction.model import AGREEMENT
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING, Axis
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.geometry.rays import ray_directions
from tofcorr.version import __version__


def c_name(stem: str) -> str:
    """Return the name that begins every public name in C, from the stem of the file's name."""
    name = re.sub(r"\W", "_", stem, flags=re.ASCII)
    return f"_{name}" if name[:1].isdigit() else name


def c_sources(state: CalibrationState, metadata: str, name: str) -> dict[str, str]:
    """Return the text of every file by the file's name.

    Args:
        state: The calibration.
        metadata: As `corrector.metadata()`.
        name: As `c_name` gives it.

    Raises:
        ConfigError: C cannot hold one of the terms.
    """
    values = _values(state, metadata, name)
    environment = Environment(
        loader=FunctionLoader(_template),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters.update(f=number, d=long_number, floats=numbers, doubles=long_numbers)
    return {
        target: environment.get_template(f"corrector{source}.j2").render(values)
        for target, source in (
            (f"{name}.h", ".h"),
            (f"{name}.c", ".c"),
            (f"{name}_test.c", "_test.c"),
        )
    }


def _template(name: str) -> str:
    return files("tofcorr.correction.export.c_code").joinpath(name).read_text(encoding="utf-8")


@torch.no_grad()
def _values(state: CalibrationState, metadata: str, name: str) -> dict[str, Any]:
    """Return what the templates fill in, for frames of the mean conditions.

    Raises:
        ConfigError: A term cannot be held.
    """
    model, camera, is_z = state.model().error, state.camera, state.depth_kind == "z"
    limits, network = model.limits(state.domain), model.residual
    amplitudes = limits.amplitude or EVERYTHING
    runtime = RuntimeErrorModel(model, limits, 1.0)
    row_error, column_error, rest = separated(model.pixel_error() + runtime.left_over)
    pieces = [pieces_of(term, limits) for term in summed_polynomials(model)[1]]
    variables = {axis.variable for one in pieces for axis in one.axes}
    needs_amplitude = model.needs_amplitude()
    most = state.saturation_amplitude
    saturation = most is not None and not (needs_amplitude and amplitudes.high < np.float32(most))
    return {
        "title": comment(f"Depth correction {state.name}."),
        "camera": f"A camera of {camera.width} x {camera.height} pixels.",
        "version": __version__,
        "name": name,
        "upper": name.upper(),
        "guard": f"{name.upper()}_H",
        # Pixels that are corrected together: five arrays of them take a fifth of a first-level
        # cache of 32 KiB; fewer spend more on the ends of the loops. Set on benchmarks/runtime.py.
        "block": min(320, camera.width),
        "width": camera.width,
        "height": camera.height,
        "row_error": row_error[:, 0].numpy(),
        "column_error": column_error[0].numpy(),
        "error_image": None if rest is None else rest.numpy(),
        "z_of_radial": ray_directions(camera)[..., 2].numpy() if is_z else None,
        "limits": limits,
        "saturation_amplitude": most,
        "is_z": is_z,
        # The clamped distance is read in float32; depth along the axis is tested in double.
        "uses_distance": not is_z or "distance" in variables or runtime.distance.degree > 0,
        "normalised": runtime.has_normalised,
        "saturation": saturation,
        "needs_amplitude": needs_amplitude,
        "reads_amplitude": needs_amplitude or saturation,
        "marks_amplitude": needs_amplitude
        and not (runtime.has_amplitude or runtime.has_normalised),
        "has_log": "log_amplitude" in variables or (network is not None and network.uses_amplitude),
        "polynomials": _polynomials(runtime),
        "pieces": [_pieces(one) for one in pieces],
        "network": None if network is None else _network(network),
        "conditions": _conditions(
            is_z=is_z,
            reaches_zero=limits.radial_distance.low <= 0,
            needs_amplitude=needs_amplitude,
            normalised=runtime.has_normalised,
            saturation=saturation,
        ),
        "tolerance": AGREEMENT,
        "probes": _probes(state),
        "metadata": lines((str(byte) for byte in [*metadata.encode(), 0]), 24),
    }


def _conditions(
    *, is_z: bool, reaches_zero: bool, needs_amplitude: bool, normalised: bool, saturation: bool
) -> list[str]:
    """Return what must hold for a pixel to be valid."""
    exact = ["(exact[i] >= (double)NEAREST)", "(exact[i] <= (double)FARTHEST)"]
    bounds = ["(normalised[i] >= LEAST_NORMALISED)", "(normalised[i] <= MOST_NORMALISED)"]
    return [
        *(exact if is_z else ["(distance[i] == depth[i])"]),
        *(["(seen[i] == seen[i])"] if reaches_zero else []),
        *(["(strength[i] == amplitude[i])"] if needs_amplitude else []),
        *(bounds if normalised else []),
        *(["!(amplitude[i] >= SATURATION)"] if saturation else []),
    ]


def _polynomials(runtime: RuntimeErrorModel) -> list[dict[str, str]]:
    variables = (
        (runtime.distance, "distance[i]"),
        (runtime.amplitude, "strength[i]"),
        (runtime.normalised, "held[i]"),
    )
    return [
        {
            "variable": variable if one.shift == 0 else f"{variable} - {number(one.shift)}",
            "horner": _horner(one),
        }
        for one, variable in variables
        if one.degree
    ]


def _horner(one: RuntimePolynomial) -> str:
    text = number(one.values[-1])
    for value in reversed(one.values[:-1]):
        text = f"({number(value)} + x * {text})"
    return f"x * {text}"


def _pieces(pieces: Pieces) -> dict[str, Any]:
    axes, flat = pieces.axes, pieces.coefficients.reshape(-1, 4 ** len(pieces.axes))
    return {
        "axes": [{"position": _position(axis), "segments": axis.segments} for axis in axes],
        "words": " and ".join(axis.variable.replace("_", " of the ") for axis in axes),
        "powers": "1, t, t^2, t^3" if len(axes) == 1 else "s^p t^q, q first",
        "index": "k1" if len(axes) == 1 else f"k1 * {axes[1].segments} + k2",
        "count": len(flat),
        "size": flat.shape[1],
        "rows": rows(flat),
    }


def _position(axis: Axis) -> str:
    value = {"distance": "distance[i]", "amplitude": "strength[i]"}.get(axis.variable)
    if value is None:
        floor = number(np.exp(axis.low))
        value = f"natural_log(strength[i] > {floor} ? strength[i] : {floor})"
    length = axis.high - axis.low
    return f"({value} - {number(axis.low)}) * {number(axis.segments / length if length else 0.0)}"


def _network(network: ResidualNetwork) -> dict[str, Any]:
    layers = network.first, network.second, network.last
    weights = [layer.weight.detach().numpy() for layer in layers]
    biases = [layer.bias.detach().numpy() for layer in layers]
    centre, half_width = network.centre.tolist(), network.half_width.tolist()
    return {
        "neurons": len(biases[0]),
        "first_weight": rows(weights[0]),
        "first_bias": numbers(biases[0]),
        "second_weight": rows(weights[1]),
        "second_bias": numbers(biases[1]),
        "last_weight": numbers(weights[2]),
        "last_bias": float(biases[2][0]),
        "margin": network.margin,
        "bound": network.bound,
        "centre": centre,
        "half_width": half_width,
        "uses_amplitude": network.uses_amplitude,
        "floor": float(network.floor),
        # There the input is 2, where the network has long faded to zero.
        "ceiling": float(np.exp(centre[1] + 2.0 * half_width[1])),
    }


def _probes(state: CalibrationState) -> str:
    depth, amplitude = probe_frames(state)
    expected, valid = state.corrected(depth, amplitude)
    pixels = depth[0].numel()
    # 1 % of the pixels is of each kind of missing value: each kind is there five times.
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(pixels, generator=generator)[:512].tolist()
    columns = (one[0].flatten()[chosen].tolist() for one in (depth, amplitude, expected, valid))
    return "\n".join(
        f"  {{{k}, {number(d)}, {number(a)}, {long_number(e)}, {int(v)}}},"
        for k, d, a, e, v in zip(chosen, *columns, strict=True)
    )


def comment(text: str) -> str:
    """Return a text that neither ends a comment nor begins one."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def number(value: float) -> str:
    """Return a constant of type float, with all its digits."""
    return _special(value) or f"{np.float32(value):.8e}f"


def long_number(value: float) -> str:
    """Return a constant of type double, with all its digits."""
    return _special(value) or f"{value:.16e}"


def numbers(values: np.ndarray) -> str:
    """Return the entries of a table of floats, as many lines as they take."""
    return lines(map(number, values.ravel()))


def long_numbers(values: np.ndarray) -> str:
    """Return the entries of a table of doubles, as many lines as they take."""
    return lines(map(long_number, values.ravel()))


def rows(values: np.ndarray) -> str:
    """Return the rows of a two-dimensional table of floats, each in braces and a line."""
    return "\n".join("  {" + ", ".join(map(number, row)) + "}," for row in values)


def lines(words: Iterable[str], in_a_line: int = 6) -> str:
    """Return words behind commas, so many in a line."""
    every = list(words)
    parts = (every[k : k + in_a_line] for k in range(0, len(every), in_a_line))
    return "\n".join("  " + ", ".join(part) + "," for part in parts)


def _special(value: float) -> str | None:
    if np.isnan(value):
        return "NAN"
    return f"{'-' if value < 0 else ''}INFINITY" if np.isinf(value) else None
