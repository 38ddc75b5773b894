"""Writes the corrector as C source: header, source and test program, from templates."""

import re
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, FunctionLoader, StrictUndefined

from tofcorr.correction.export.c_code.content import Content, content_of
from tofcorr.correction.export.c_code.pieces import Pieces
from tofcorr.correction.export.c_code.writing import (
    comment,
    lines,
    long_number,
    long_numbers,
    number,
    numbers,
    rows,
)
from tofcorr.correction.export.parity import TOLERANCE, probe_frames
from tofcorr.correction.reference import corrected_by_model
from tofcorr.correction.runtime_polynomial import RuntimePolynomial
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.bases import Axis
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.version import __version__

# Pixels that are corrected together (no unit). Five arrays of them take a fifth of a first-level
# cache of 32 KiB; fewer spend more on the ends of the loops. Set on benchmarks/runtime.py.
_BLOCK = 320
# Pixels of which the test program knows what the model says (no unit). Chosen: 1 % of the pixels
# is of each kind of missing value, so that each kind is there five times.
_NUM_PROBES = 512


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
    content = content_of(state)
    values = _values(state, content, metadata, name)
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


def _values(state: CalibrationState, content: Content, metadata: str, name: str) -> dict[str, Any]:
    """Return what the templates fill in."""
    limits, runtime = content.limits, content.polynomials
    saturation = state.saturation_amplitude is not None and not (
        content.needs_amplitude and limits.amplitude.high < limits.saturation_amplitude
    )
    camera = state.camera
    polynomial_in_amplitude = runtime.has_amplitude or runtime.has_normalised
    return {
        "title": comment(f"Depth correction {state.name}."),
        "camera": f"A camera of {camera.width} x {camera.height} pixels.",
        "version": __version__,
        "name": name,
        "upper": name.upper(),
        "guard": f"{name.upper()}_H",
        "block": min(_BLOCK, content.width),
        "content": content,
        "limits": limits,
        "is_z": content.z_of_radial is not None,
        "uses_distance": _uses_distance(content),
        "normalised": runtime.has_normalised,
        "saturation": saturation,
        "reads_amplitude": content.needs_amplitude or saturation,
        "marks_amplitude": content.needs_amplitude and not polynomial_in_amplitude,
        "has_log": _has_log(content),
        "polynomials": _polynomials(content),
        "pieces": [_pieces(one) for one in content.pieces],
        "network": None if content.network is None else _network(content.network),
        "conditions": _conditions(content, saturation),
        "tolerance": TOLERANCE,
        "probes": _probes(state),
        "metadata": lines((str(byte) for byte in [*metadata.encode(), 0]), 24),
    }


def _has_log(content: Content) -> bool:
    """Whether the logarithm of an amplitude is taken."""
    in_pieces = any(a.variable == "log_amplitude" for one in content.pieces for a in one.axes)
    return in_pieces or (content.network is not None and content.network.uses_amplitude)


def _uses_distance(content: Content) -> bool:
    """Whether the clamped distance is read in float32; depth along the axis is tested in double."""
    in_pieces = any(axis.variable == "distance" for one in content.pieces for axis in one.axes)
    return content.z_of_radial is None or in_pieces or content.polynomials.distance.degree > 0


def _conditions(content: Content, saturation: bool) -> list[str]:
    """Return what must hold for a pixel to be valid."""
    found = ["(distance[i] == depth[i])"]
    if content.z_of_radial is not None:
        found = ["(exact[i] >= (double)NEAREST)", "(exact[i] <= (double)FARTHEST)"]
    if content.limits.radial_distance.low <= 0:
        found.append("(seen[i] == seen[i])")
    if content.needs_amplitude:
        found.append("(strength[i] == amplitude[i])")
    if content.polynomials.has_normalised:
        found += ["(normalised[i] >= LEAST_NORMALISED)", "(normalised[i] <= MOST_NORMALISED)"]
    if saturation:
        found.append("!(amplitude[i] >= SATURATION)")
    return found


def _polynomials(content: Content) -> list[dict[str, str]]:
    runtime = content.polynomials
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
    expected, valid = corrected_by_model(state, depth, amplitude)
    pixels = depth[0].numel()
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(pixels, generator=generator)[:_NUM_PROBES].tolist()
    columns = (one[0].flatten()[chosen].tolist() for one in (depth, amplitude, expected, valid))
    return "\n".join(
        f"  {{{k}, {number(d)}, {number(a)}, {long_number(e)}, {int(v)}}},"
        for k, d, a, e, v in zip(chosen, *columns, strict=True)
    )
