"""A simulator that behaves as a fit says: its options can be written out and run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.select import Selection
from tofcorr.diagnosis.findings.which import fitted_coefficients
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.map_gain import whole_map
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.amplitude import AmplitudePolynomial
from tofcorr.error_terms.base import SignalTerm
from tofcorr.geometry import se3
from tofcorr.geometry.ranges import unambiguous_range
from tofcorr.simulation.camera_mount import CameraMountOptions
from tofcorr.simulation.delays import (
    AmplitudeTable,
    CurveTable,
    LatticeTable,
    MeasuredErrorOptions,
)
from tofcorr.simulation.effects import CatalogueEffect
from tofcorr.simulation.light import LightOptions
from tofcorr.simulation.options import CameraOptions, SensorOptions, ShotOptions, SimulatorOptions
from tofcorr.simulation.readout import ReadoutOptions
from tofcorr.simulation.scene import SceneOptions, UniformTarget

_KNOTS = 13
_LATTICE = 9
_DEFAULT_FREQUENCY = 20.0e6


def solution_of(study: Study, selection: Selection | None) -> tuple[Tensor, Tensor]:
    """Return the hand-eye transform (4, 4) and the error model's coefficients of a model.

    Args:
        study: The recording.
        selection: The model with effects; None: the base model alone.
    """
    fit, blocks = study.fit, study.blocks
    if selection is None:
        return fit.tool_from_camera, fit.coefficients
    blocks = selection.study.blocks
    theta = solve(blocks.even, selection.columns)[: blocks.layout.base]
    count = fit.model.num_hand_eye
    pose = fit.tool_from_camera
    if count:
        pose = pose @ se3.exp(theta[:count])
    return pose, fit.coefficients + theta[count:]


def fitted_effects(study: Study, selection: Selection) -> list[CatalogueEffect]:
    """Return the selected effects with their fitted coefficients."""
    fitted = fitted_coefficients(selection.study, selection.columns)
    effects: list[CatalogueEffect] = [
        selection.study.effects[name].with_coefficients(c) for name, c in fitted.items()
    ]
    for name in selection.named:
        if name in study.maps:
            # Cross-fitted values were taken off; the map itself is estimated from all poses.
            residual = study.residual_of(selection.columns)
            effect = study.maps[name]
            effects.append(effect.with_coefficients(whole_map(study, effect, residual)))
    return effects


def simulator_of(
    study: Study, selection: Selection | None, given: SimulatorOptions | None
) -> SimulatorOptions:
    """Return the simulator that the fit describes.

    Args:
        study: The recording.
        selection: With these effects; None: base model alone.
        given: The simulator under diagnosis, to which the refitted errors are added; None: one
            made from the recording alone.
    """
    recording = study.observations.recording
    pose, coefficients = solution_of(study, selection)
    options = _plain(recording, study.observations, study.fit) if given is None else given
    measured = _tables(study, coefficients, options.sensor.delays.measured)
    delays = options.sensor.delays.model_copy(update={"measured": measured})
    sensor = options.sensor.model_copy(update={"delays": delays})
    effects = tuple(options.effects)
    if selection is not None:
        effects += tuple(effect.to_mapping() for effect in fitted_effects(study, selection))
    changes: dict[str, Any] = {
        "sensor": sensor,
        "effects": effects,
        "hand_eye": CameraMountOptions.from_matrix(pose),
    }
    return options.model_copy(update=changes)


def _plain(recording: Recording, observations: Observations, fit: BaseFit) -> SimulatorOptions:
    """Return a sensor without errors, as noisy as the recording, with its targets and frames."""
    names = sorted(set(recording.frames.target.tolist()))
    counts = {name: int((recording.frames.target == name).sum()) for name in names}
    frequency = recording.modulation_frequency or _DEFAULT_FREQUENCY
    light = LightOptions()
    electrons_per_count = ReadoutOptions().electrons_per_count
    electrons_at_1m = light.electrons_at_1m
    if observations.amplitude is not None:
        amplitude = float(observations.amplitude.median())
        scale = unambiguous_range(frequency) / (2 * np.pi)
        noise = float(fit.sigma.median())
        # Shot noise: sigma = scale sqrt(B / 2) / A, with the mean B = A / contrast.
        electrons = scale**2 / (2 * light.demodulation_contrast * noise**2)
        electrons_per_count = max(electrons / max(amplitude, 1e-12), 1e-9)
        distance = float(observations.measured.median())
        electrons_at_1m = electrons * distance**2 / (0.5 * light.demodulation_contrast)
    return SimulatorOptions(
        camera=CameraOptions.of(recording.camera),
        depth_kind=recording.depth_kind,
        shots=tuple(ShotOptions(target=name, poses=n) for name, n in counts.items()),
        scene=SceneOptions(
            targets={name: UniformTarget() for name in names} | SceneOptions().targets
        ),
        sensor=SensorOptions(
            modulation_frequency_hz=frequency,
            light=light.model_copy(update={"electrons_at_1m": electrons_at_1m}),
            readout=ReadoutOptions(
                electrons_per_count=electrons_per_count,
                read_noise_electrons=0.0,
                converter_bits=32,
            ),
        ),
    )


def _tables(
    study: Study, coefficients: Tensor, already: MeasuredErrorOptions
) -> MeasuredErrorOptions:
    """Return the error model as tables, on top of those that the simulator has."""
    model = study.fit.model
    parts = _split(coefficients, [1, *(len(t.symbols) for t in model.signal_terms)])
    constant = float(parts[0][0]) + already.constant_m
    distance = _curve_values(study.observations.measured)
    by_distance = np.zeros(_KNOTS)
    amplitudes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for term, own in zip(model.signal_terms, parts[1:], strict=False):
        if not term.needs_amplitude:
            knots = torch.from_numpy(distance)
            by_distance += (own @ term.basis(knots, knots).detach()).numpy()
            continue
        variable, knots, values = _amplitude_curve(study, term, own)
        before = amplitudes.get(variable, (knots, np.zeros_like(knots)))[1]
        amplitudes[variable] = (knots, before + values)
    by_pixel = _lattice(study, coefficients)
    changes: Mapping[str, Any] = {
        "constant_m": constant,
        "distance": _sum_of_curves(distance, by_distance, already.distance),
        "pixel": _sum_of_lattices(by_pixel, already.pixel),
        "amplitude": _amplitude_table(amplitudes, already.amplitude),
    }
    return already.model_copy(update=dict(changes))


def _split(coefficients: Tensor, sizes: Sequence[int]) -> list[Tensor]:
    ends = np.cumsum(sizes)
    return [coefficients[end - size : end] for size, end in zip(sizes, ends, strict=True)]


def _curve_values(values: Tensor) -> np.ndarray:
    return np.linspace(float(values.min()), float(values.max()), _KNOTS)


def _amplitude_curve(
    study: Study,
    term: SignalTerm,
    own: Tensor,
) -> tuple[str, np.ndarray, np.ndarray]:
    """Return variable, knots and values of an amplitude term."""
    observations = study.observations
    assert observations.amplitude is not None
    normalised = isinstance(term, AmplitudePolynomial) and term.variable == "normalised_amplitude"
    values = observations.amplitude
    if normalised:
        values = values * observations.measured**2
    # Dark pixels bend the curve most: knots are dense there.
    low, high = float(values.min()), float(values.max())
    knots = low + (high - low) * np.linspace(0.0, 1.0, 2 * _KNOTS) ** 2
    at = torch.from_numpy(knots)
    curve = (own @ term.basis(torch.ones_like(at), at).detach()).numpy()
    return ("normalised_amplitude" if normalised else "amplitude"), knots, curve


def _amplitude_table(
    found: dict[str, tuple[np.ndarray, np.ndarray]], already: AmplitudeTable | None
) -> AmplitudeTable | None:
    if not found:
        return already
    variable, (knots, values) = next(iter(found.items()))
    if already is not None and already.variable == variable:
        values = values + already.curve()(torch.from_numpy(knots)).numpy()
    return AmplitudeTable(
        knots=tuple(knots.tolist()),
        values_m=tuple(values.tolist()),
        variable=variable,  # type: ignore[arg-type]
    )


def _sum_of_curves(knots: np.ndarray, values: np.ndarray, already: CurveTable | None) -> CurveTable:
    if already is not None:
        values = values + already.curve()(torch.from_numpy(knots)).numpy()
    return CurveTable(knots=tuple(knots.tolist()), values_m=tuple(values.tolist()))


def _lattice(study: Study, coefficients: Tensor) -> np.ndarray:
    """Return the pixel terms on a lattice from corner to corner."""
    model = study.fit.model
    camera = study.observations.recording.camera
    total = np.zeros((_LATTICE, _LATTICE))
    start = len(coefficients) - sum(len(term.symbols) for term in model.pixel_terms)
    rows = torch.linspace(0, camera.height - 1, _LATTICE).double()
    columns = torch.linspace(0, camera.width - 1, _LATTICE).double()
    at = torch.cartesian_prod(rows, columns)
    for term in model.pixel_terms:
        own = coefficients[start : start + len(term.symbols)]
        start += len(term.symbols)
        values = own @ term.basis(at[:, 0], at[:, 1]).detach()
        total += values.reshape(_LATTICE, _LATTICE).numpy()
    return total


def _sum_of_lattices(values: np.ndarray, already: LatticeTable | None) -> LatticeTable:
    if already is not None:
        from tofcorr.simulation.splines import image_from_lattice

        values = values + image_from_lattice(already.values_m, _LATTICE, _LATTICE).numpy()
    return LatticeTable(values_m=tuple(tuple(row) for row in values.tolist()))
