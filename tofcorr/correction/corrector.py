"""The corrector that runs on the robot: the reference, folded into few passes in float32."""

import copy
import json
import math

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.correction.model import AGREEMENT
from tofcorr.correction.runtime_sigma import RuntimeSigma, frozen
from tofcorr.correction.state import CalibrationState, corrector_metadata
from tofcorr.error_terms.base import EVERYTHING, Domain, Interval, ScaledPolynomial, SignalTerm
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.error_terms.signal_terms import unscale
from tofcorr.geometry.se3 import transformed
from tofcorr.scene_light.bounces import SecondBounces
from tofcorr.scene_light.flying import FlyingPixels
from tofcorr.scene_light.stray import StrayLight
from tofcorr.scene_light.unremoved import UnremovedBounces

# The error is computed times -2^40, so that `torch.lerp` with the weight w = 2^-40 subtracts it:
# depth + w (-e / w - depth). Unlike a plain subtraction this turns an infinite depth into NaN in
# the same pass. It changes the depth by 1e-12 of itself, far below the resolution of float32.
_WEIGHT = 2.0**-40

# Number of pixels that are corrected at once on a CPU. For many pixels the allocator returns the
# temporaries to the system after every call, and getting them back page by page takes longer than
# the arithmetic; for few, the calls dominate. Set on benchmarks/runtime.py.
_STRIP_PIXELS = 400_000


class DepthCorrector(nn.Module):
    """Corrects depth frames in float32: the module that becomes `corrector.ts`.

    `corrected, valid = corrector(depth, amplitude)`. Input and output are depth of the camera's
    kind, radial or z; the error is a function of the radial distance.

    * A pixel without a return (NaN, infinite, zero or negative) gives NaN and is not valid.
    * Outside the calibrated range of distance or amplitude the error at the range's edge is
      subtracted, and the pixel is not valid.
    * A saturated pixel is not valid.
    * An amplitude of NaN gives NaN and is not valid, if the model depends on the amplitude. If it
      does not, amplitudes only matter for saturation.
    * A residual network fades to zero outside the calibrated range.
    * Stray light of the camera's own is taken back first, where the calibration knows it.
    * Second bounces of light are removed after the camera's own error, where the calibration has
      their gain.
    * A flying pixel is not valid, where the calibration has these found. Where one surface is
      certain, its depth is given.
    * Frames are taken to have the mean conditions (time, integration time, temperature) of the
      calibration, until `set_conditions` is called.

    Use `from_state`. The module has no trainable parameter and writes in place; for autograd there
    is `tofcorr.DepthCorrection`.

    Args:
        state: The calibration.

    Shape:
        - Input: `(H, W)` or `(B, H, W)` twice, float32: metres, and the camera's amplitude units.
        - Output: the same shape, float32 metres; the same shape, bool.
    """

    radial_of_z: Tensor
    points_at_one: Tensor
    tool_from_camera: Tensor
    mean_conditions: list[float]
    si_per_unit: list[float]

    def __init__(self, state: CalibrationState) -> None:
        super().__init__()
        reference = state.correction()
        error, geometry = reference.error_model, reference.geometry
        limits = error.limits(state.domain)
        amplitudes = limits.amplitude or EVERYTHING
        self.height: int = state.camera.height
        self.width: int = state.camera.width
        self.strip_pixels: int = _STRIP_PIXELS
        self.in_strips: bool = True
        self.weight: float = _WEIGHT
        self.is_z: bool = state.depth_kind == "z"
        self.radial_range = RuntimeRange(limits.radial_distance, positive=True)
        self.amplitude_range = RuntimeRange(amplitudes)
        self.normalised_range = tuple(limits.normalised_amplitude or EVERYTHING)
        self.saturation: float = float(reference.ranges.saturation_amplitude)
        # If the calibrated range ends below saturation, it already excludes saturated pixels.
        known = self.saturation < math.inf
        self.checks_saturation: bool = known and amplitudes.high >= self.saturation
        self.error = RuntimeErrorModel(error, limits, -1.0 / _WEIGHT)
        self.mean_conditions = state.domain.mean_conditions()
        self.si_per_unit = [condition(name).si_per_unit for name in CONDITIONS]
        self.conditions_inside: bool = True
        self.known_sigma = RuntimeSigma(state, error, limits)
        self.stray: StrayLight | None = state.stray_light()
        self.bounces: SecondBounces | None = state.second_bounces()
        self.unremoved: UnremovedBounces | None = None
        if self.bounces is not None and state.scene.second_bounces is not None:
            own = self.known_sigma if self.known_sigma.knows_calibration else None
            self.unremoved = UnremovedBounces(self.bounces, state.scene.second_bounces, own)
        self.flying: FlyingPixels | None = state.flying_pixels()
        scale = geometry.radial_of_depth if self.is_z else geometry.radial_of_depth[:1, :1]
        points = geometry.points(torch.ones_like(geometry.radial_of_depth))
        self.register_buffer("radial_of_z", scale.float().contiguous())
        self.register_buffer("points_at_one", points.float().contiguous())
        self.register_buffer("tool_from_camera", state.tool_from_camera.detach().float().clone())
        self.metadata_text: str = json.dumps(corrector_metadata(state), allow_nan=False)

    @classmethod
    def from_state(cls, state: CalibrationState) -> "DepthCorrector":
        """Build the corrector of a calibration."""
        return cls(state).eval()

    def forward(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return corrected depth, metres, and where it is valid.

        Raises:
            ValueError: Shape or dtype are not those of the camera (`torch.jit.Error` once
                scripted).
        """
        corrected, amplitude, valid = self.without_own_error(depth, amplitude)
        if self.bounces is not None:
            corrected = self.bounces(corrected * self.radial_of_z, amplitude) / self.radial_of_z
        if self.flying is not None:
            return self.flying(corrected, amplitude, valid)
        return corrected, valid

    def without_own_error(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return depth and amplitude without what the camera itself adds, and where it is valid."""
        check_frames(depth, amplitude, self.height, self.width)
        depth, amplitude = self.without_stray_light(depth, amplitude)
        depth, amplitude = depth.contiguous(), amplitude.contiguous()
        corrected = torch.empty_like(depth)
        valid = torch.empty_like(depth, dtype=torch.bool)
        # Without strips nothing asks for the size: an exported graph must hold for any batch.
        if self.in_strips and depth.numel() > self.strip_pixels and not depth.is_cuda:
            self.correct_in_strips(depth, amplitude, corrected, valid)
        else:
            self.correct(depth, amplitude, self.error.offset, 0, corrected, valid)
        if not self.conditions_inside:
            valid.zero_()
        return corrected, amplitude, valid

    def without_stray_light(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return depth and amplitude as they were without the camera's own stray light."""
        if self.stray is None:
            return depth, amplitude
        radial, amplitude = self.stray(depth * self.radial_of_z, amplitude)
        return radial / self.radial_of_z, amplitude

    def set_conditions(
        self,
        timestamp_s: float | None = None,
        integration_time_us: float | None = None,
        room_temperature_c: float | None = None,
        body_temperature_c: float | None = None,
        ambient: float | None = None,
    ) -> None:
        """Set the conditions of the next frames; what is not given is the calibration's mean.

        Conditions that the model does not depend on change nothing. Outside the calibrated range
        the error at the range's edge is subtracted, and no pixel is valid.

        Args:
            timestamp_s: Seconds since the camera was started as for the calibration.
            integration_time_us: Microseconds.
            room_temperature_c: Degrees Celsius.
            body_temperature_c: Degrees Celsius.
            ambient: Background light, the camera's units.
        """
        values = torch.tensor(self.mean_conditions, dtype=torch.float64)
        given = [timestamp_s, integration_time_us, room_temperature_c, body_temperature_c, ambient]
        for k, value in enumerate(given):
            if value is not None:
                values[k] = value * self.si_per_unit[k]
        self.conditions_inside = self.error.set_conditions(values.to(self.radial_of_z.device))

    def set_pose(self, world_from_tool: Tensor) -> None:
        """Set the tool's pose in the next frames, (4, 4), or one of each frame of a batch.

        Only a room in the axes of the world needs it; it is used from then on.
        """
        if self.bounces is not None:
            tool = world_from_tool.double()
            self.bounces.room.set_pose(tool @ self.tool_from_camera.double())

    def points(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return corrected points in the camera frame, shape (..., H, W, 3), metres."""
        corrected, _ = self.forward(depth, amplitude)
        return corrected.unsqueeze(-1) * self.points_at_one

    def points_tool(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return corrected points in the tool frame, shape (..., H, W, 3), metres."""
        return transformed(self.tool_from_camera, self.points(depth, amplitude))

    def sigma(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return how uncertain the corrected depth is, by noise and by calibration, metres.

        Standard deviations of depth of the camera's kind, the shape of `depth`. Noise is
        independent from frame to frame; the calibration's error is the same in every frame. NaN
        where there is no return, or where the calibration states none.
        """
        check_frames(depth, amplitude, self.height, self.width)
        radial = depth * self.radial_of_z
        rows, columns = self.error.rows, self.error.columns
        noise, calibration = self.known_sigma(radial, amplitude, rows, columns)
        return noise / self.radial_of_z, calibration / self.radial_of_z

    def uncertainty(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return the standard deviation of the corrected depth, all that is known, metres.

        Noise and calibration, as `sigma` has them, what second bounces still add or lack, and what
        flying pixels that were not found add beside those that were. Of depth of the camera's kind,
        the shape of `depth`. Errors of second bounces are alike in neighbouring pixels, and in
        frames of one scene. NaN as `sigma`. A flying pixel has none that holds: it is not valid.
        """
        noise, calibration = self.sigma(depth, amplitude)
        variance = noise.square() + calibration.square()
        corrected, light, valid = self.without_own_error(depth, amplitude)
        if self.unremoved is not None:
            added = self.unremoved(corrected * self.radial_of_z, light, valid) / self.radial_of_z
            variance = variance + added.square()
        if self.flying is not None:
            if self.bounces is not None:
                corrected = self.bounces(corrected * self.radial_of_z, light) / self.radial_of_z
            missed = self.flying.missed(corrected, light)
            variance = variance + (missed * noise).square()
        return variance.sqrt()

    def metadata(self) -> str:
        """Return camera, model, validity range and versions as JSON text."""
        return self.metadata_text

    def correct_in_strips(
        self, depth: Tensor, amplitude: Tensor, corrected: Tensor, valid: Tensor
    ) -> None:
        """Correct some rows of all frames at a time."""
        strips = (depth.numel() + self.strip_pixels - 1) // self.strip_pixels
        rows = max(1, (self.height + strips - 1) // strips)
        parts = [depth.split(rows, -2), amplitude.split(rows, -2)]
        outputs = [corrected.split(rows, -2), valid.split(rows, -2)]
        for k, offset in enumerate(self.error.offset.split(rows)):
            given, own = (parts[0][k], parts[1][k]), (outputs[0][k], outputs[1][k])
            self.correct(given[0], given[1], offset, k * rows, own[0], own[1])

    def correct(
        self,
        depth: Tensor,
        amplitude: Tensor,
        offset: Tensor,
        first: int,
        corrected: Tensor,
        valid: Tensor,
    ) -> None:
        """Correct rows, from the number `first` on, into `corrected` and `valid` (bool or number).

        Speed depends on the number of arrays that each operation reads and writes. So `corrected`
        also holds intermediate results, and masks are float 0 and 1: comparisons that give bool
        are not vectorised.
        """
        rows, radial_of_z, radial = self.error.rows, self.radial_of_z, depth
        if depth.shape[-2] < self.height:
            rows = rows[first : first + depth.shape[-2]]
            radial_of_z = radial_of_z[first : first + depth.shape[-2]] if self.is_z else radial_of_z
        if self.is_z:
            radial = depth * radial_of_z
        # A missing return becomes NaN here, and stays NaN in all that follows.
        distance = self.radial_range.held(radial)
        error = self.error.distance(offset, distance, corrected)
        strength = amplitude
        if self.error.needs_amplitude:
            strength = self.amplitude_range.held(amplitude)
        if self.error.has_amplitude:
            self.error.amplitude.add_to(error, strength)
        self.error.add_others(error, distance, strength)
        if self.error.network is not None:  # Its inputs are not clamped.
            found = self.error.network(radial, amplitude, rows, self.error.columns)
            error.add_(found, alpha=self.error.factor)
        if self.error.has_normalised:
            normalised = (strength * distance).mul_(distance)
            held = torch.clamp(normalised, self.normalised_range[0], self.normalised_range[1])
            self.error.normalised.add_to(error, held)
            inside = self.radial_range.inside(radial, distance).mul_(normalised.eq_(held))
        else:
            inside = self.radial_range.inside(radial, distance)
        if self.error.needs_amplitude:
            inside.mul_(self.amplitude_range.inside(amplitude, strength))
        if self.checks_saturation:
            inside.gt_(amplitude.clone().ge_(self.saturation))
        valid.copy_(inside)
        if self.is_z:
            error.div_(radial_of_z)
        torch.lerp(depth, error, self.weight, out=corrected)


# What the file offers besides `forward`. Set here, not when it is compiled: TorchScript compiles a
# class once, whoever asks first.
if hasattr(torch, "jit"):  # Later versions of torch may lack it.
    for _name in (
        "set_conditions",
        "set_pose",
        "points",
        "points_tool",
        "sigma",
        "uncertainty",
        "metadata",
    ):
        torch.jit.export(getattr(DepthCorrector, _name))


class RuntimeRange(nn.Module):
    """A calibrated range, in the form that is fastest for a chain of operations or compiled code.

    Args:
        interval: The range; both ends belong to it.
        positive: Whether zero and less are missing values, never inside and NaN once held.

    Attributes:
        fused: Whether the operations are compiled into one pass. Then a value inside is held to a
            few roundings, by subtractions and maxima alone: the code that is generated for clamps
            and choices, which turns masks into vectors and back, takes twice the time.
    """

    def __init__(self, interval: Interval, *, positive: bool = False) -> None:
        super().__init__()
        self.low, self.high = interval
        self.positive: bool = positive
        # Less than the smallest positive number of float32 is no distance.
        self.least: float = max(self.low, 2.0**-149) if positive else self.low
        self.fused: bool = False

    def held(self, x: Tensor) -> Tensor:
        """Return x held to the range, a new tensor; NaN stays NaN."""
        if self.fused:
            if self.positive:
                # Zero times infinity is NaN; any other number becomes zero.
                x = x + torch.relu(torch.relu(x) * -math.inf)
            return self.high - torch.relu((self.high - self.low) - torch.relu(x - self.low))
        if self.positive:
            return torch.threshold(x, 0.0, math.nan).clamp_(self.low, self.high)
        return torch.clamp(x, self.low, self.high)

    def inside(self, x: Tensor, held: Tensor) -> Tensor:
        """Return 1 where x is inside, else 0, of the type of `held`, which it may overwrite.

        Args:
            x: As measured.
            held: What `held` returned.
        """
        if self.fused:
            return ((x >= self.least) & (x <= self.high)).to(held.dtype)
        return held.eq_(x)


class RuntimeErrorModel(nn.Module):
    """The predicted error times a factor, in the form that is fastest to evaluate.

    Constant and pixel terms become one image. The polynomial in a variable is evaluated in place;
    every other term runs as it is, in float32. The condition terms
    of a frame sum to one number, which `set_conditions` adds to the image.

    Args:
        model: The float64 model.
        limits: Ranges of the variables.
        factor: What to multiply by; a power of two, so that it costs no accuracy.

    Attributes:
        offset: Constant and pixel terms, times the factor, shape (H, W), float32.
        left_over: What the polynomials leave to the offset, metres.
        rows: Row numbers, shape (H, 1), float32.
        columns: Column numbers, shape (1, W), float32.
    """

    offset: Tensor
    offset_at_mean: Tensor
    rows: Tensor
    columns: Tensor

    def __init__(self, model: ErrorModel, limits: Domain, factor: float) -> None:
        super().__init__()
        found, others = polynomials(model)
        self.factor: float = factor
        near, strong = limits.radial_distance, limits.amplitude or EVERYTHING
        self.distance = RuntimePolynomial(found.get("distance"), near, factor)
        self.amplitude = RuntimePolynomial(found.get("amplitude"), strong, factor)
        normalised = found.get("normalised_amplitude")
        bounds = limits.normalised_amplitude or EVERYTHING
        self.normalised = RuntimePolynomial(normalised, bounds, factor)
        parts = (self.distance, self.amplitude, self.normalised)
        self.left_over: float = sum(one.left_over for one in parts)
        self.others = frozen(others)
        self.has_amplitude: bool = "amplitude" in found
        self.has_normalised: bool = normalised is not None
        self.needs_amplitude: bool = model.needs_amplitude()
        offset = factor * (model.pixel_error().detach() + self.left_over)
        self.register_buffer("offset", offset.float().contiguous())
        self.condition_terms = frozen(model.condition_terms, torch.float64)
        self.has_conditions: bool = len(model.condition_terms) > 0
        at_mean = self.offset.clone() if self.has_conditions else self.offset[:0]
        self.register_buffer("offset_at_mean", at_mean)
        self.network: ResidualNetwork | None = None
        if model.residual is not None:
            self.network = copy.deepcopy(model.residual).float().requires_grad_(requires_grad=False)
        rows, columns = model.pixel_grid()
        self.register_buffer("rows", rows.detach().float())
        self.register_buffer("columns", columns.detach().float())

    def add_others(self, total: Tensor, radial_distance: Tensor, amplitude: Tensor) -> None:
        """Add the terms that are not polynomials to `total`."""
        for term in self.others:
            total.add_(term(radial_distance, amplitude), alpha=self.factor)

    def set_conditions(self, conditions: Tensor) -> bool:
        """Add the condition terms of a frame (C,) to the image; return whether it is in range."""
        if not self.has_conditions:
            return True
        error = torch.zeros_like(conditions[0])
        inside = True
        for term in self.condition_terms:
            error = error + term(conditions)
            inside = inside and bool(term.covers(conditions))  # type: ignore[operator]
        self.offset.copy_(self.offset_at_mean + self.factor * float(error))
        return inside


class RuntimePolynomial(nn.Module):
    """Sum of c_k (x - shift)^k, k = 1..K, with the scaling of the variable folded into c_k.

    Where float32 allows it the shift is folded in as well, which saves one pass over memory. That
    leaves a constant, `left_over`, which the caller adds.

    Args:
        scaled: The polynomial in the scaled variable; None: zero.
        interval: The range of x.
        factor: What to multiply the polynomial by.
    """

    coefficients: Tensor
    values: list[float]

    def __init__(self, scaled: ScaledPolynomial | None, interval: Interval, factor: float) -> None:
        super().__init__()
        constant, raw, self.shift = 0.0, [], 0.0
        if scaled is not None:
            given = scaled.coefficients.detach().double().cpu()
            constant, *raw = unscale(given, scaled.centre, scaled.half_width)
            if _rounding([constant, *raw], interval) > AGREEMENT / 5:
                raw = [float(c) / scaled.half_width**k for k, c in enumerate(given, start=1)]
                constant, self.shift = 0.0, scaled.centre
        self.degree: int = len(raw)
        self.left_over: float = constant
        self.values = [factor * value for value in raw]
        self.register_buffer("coefficients", torch.tensor(self.values, dtype=torch.float32))

    def forward(self, offset: Tensor, variable: Tensor, out: Tensor) -> Tensor:
        """Return offset + p(variable), written to `out`, shape of `variable`."""
        if self.degree == 0:
            return torch.add(offset, variable, alpha=0.0, out=out)
        x = self.shifted(variable)
        if self.degree == 1:
            return torch.add(offset, x, alpha=self.values[0], out=out)
        return torch.addcmul(offset, x, self.inner(x, out), out=out)

    def add_to(self, total: Tensor, variable: Tensor) -> None:
        """Add p(variable) to `total`."""
        x = self.shifted(variable)
        if self.degree > 2:
            total.addcmul_(x, self.inner(x, torch.empty_like(x)))
        else:
            total.add_(x, alpha=self.values[0])
            if self.degree == 2:
                total.addcmul_(x, x, value=self.values[1])

    def shifted(self, variable: Tensor) -> Tensor:
        """Return variable - shift."""
        return variable - self.shift if self.shift != 0.0 else variable

    def inner(self, x: Tensor, out: Tensor) -> Tensor:
        """Return p(x) / x for a degree of at least 2, by Horner's rule, written to `out`."""
        highest = self.values[self.degree - 1]
        value = torch.add(self.coefficients[self.degree - 2], x, alpha=highest, out=out)
        for k in range(self.degree - 3, -1, -1):
            torch.addcmul(self.coefficients[k], x, value, out=value)
        return value


def check_frames(depth: Tensor, amplitude: Tensor, height: int, width: int) -> None:
    """Refuse all but a frame, or a batch of frames, of the camera in float32, without gradients.

    Raises:
        ValueError: Shape or dtype differ, or a gradient is asked for (`torch.jit.Error` once
            scripted).
    """
    if depth.dim() not in (2, 3) or list(depth.shape[-2:]) != [height, width]:
        got = f"got {list(depth.shape)}. Was the frame cropped, binned or transposed?"
        raise ValueError(f"depth: expected shape ({height}, {width}), or a batch of it; {got}")
    if list(amplitude.shape) != list(depth.shape):
        wanted = f"expected depth's shape {list(depth.shape)}"
        raise ValueError(f"amplitude: {wanted}, got {list(amplitude.shape)}.")
    if depth.dtype != torch.float32 or amplitude.dtype != torch.float32:
        got = f"got {_numbers(depth)} and {_numbers(amplitude)}"
        advice = "Convert depth to metres and both to float32."
        raise ValueError(f"depth and amplitude: expected float32, {got}. {advice}")
    if torch.is_grad_enabled() and (depth.requires_grad or amplitude.requires_grad):
        advice = "call it under torch.no_grad(), or use tofcorr.DepthCorrection"
        raise ValueError(f"a corrector writes in place and gives no gradients: {advice}.")


def _numbers(tensor: Tensor) -> str:
    """Return the type of a tensor's numbers in words: TorchScript knows types by number only."""
    whole = "int" if tensor.is_signed() else "uint"
    kind = "float" if tensor.is_floating_point() else whole
    return kind + str(8 * tensor.element_size())


def polynomials(model: ErrorModel) -> tuple[dict[str, ScaledPolynomial], list[SignalTerm]]:
    """Return a polynomial in each variable that has one, and the other terms."""
    found: dict[str, ScaledPolynomial] = {}
    others: list[SignalTerm] = []
    for term in model.signal_terms:
        own: ScaledPolynomial | None = term.polynomial()  # type: ignore[operator, assignment]
        if own is None or own.variable in found:
            others.append(term)  # type: ignore[arg-type]
        else:
            found[own.variable] = own
    return found, others


def separated(error: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Split an image of errors (H, W), metres, float64, into rows plus columns, plus the rest.

    Returns:
        Rows (H, 1), columns (1, W), and the rest (H, W); None if it is negligible: below a
        hundredth of `AGREEMENT`.
    """
    rows = error.mean(dim=1, keepdim=True)
    columns = error.mean(dim=0, keepdim=True) - error.mean()
    rest = error - rows - columns
    return rows, columns, rest if bool(rest.abs().max() > AGREEMENT / 100) else None


def _rounding(raw: list[float], interval: Interval) -> float:
    """Return the largest error of Horner's rule in float32, with coefficients of 1, x, ...

    It is measured at 4097 points of the range: a polynomial of low degree is smooth between them.
    """
    places = np.linspace(*interval, 4097).astype(np.float32)
    exact, rounded = np.zeros(len(places)), np.zeros_like(places)
    for coefficient in reversed(raw):
        exact = exact * places + coefficient
        rounded = rounded * places + np.float32(coefficient)
    return float(np.abs(exact - rounded).max())
