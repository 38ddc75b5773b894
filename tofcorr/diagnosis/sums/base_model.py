r"""The columns of the base model: hand-eye transform, estimated walls, constant, error terms.

Planes that an importer found in the depth are nuisance parameters. An estimated plane has absorbed
part of the camera's errors. The diagnosis therefore fits every such wall again, together with
hand-eye transform and error terms, in the base fit, in each fold and beside each effect. A wall
n . x + d = 0 has three parameters: two turns of its normal and a shift of d. For a point p, seen
along the ray r, the predicted distance D changes by

.. math:: \frac{\partial D}{\partial a} = -\frac{t \cdot p}{n \cdot r}, \quad
          \frac{\partial D}{\partial d} = -\frac{1}{n \cdot r}

with the normal's tangent vector t.

Where no amplitude was recorded, an error that depends on it would pass for another effect:
wiggling, incidence, pixel, lens. The amplitude of a uniform target follows from geometry and
exposure,

.. math:: b = \tau \cos\theta / D^2 ,

up to its reflectivity and the vignetting. The columns b, b^2 and b r^2, for each target, with r the
distance from the image centre, are therefore part of the base model. What looks like them is not
named. What differs within a target, as between the squares of a checkerboard, stays in the
residual.
"""

from copy import copy
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.noise import inverse_square
from tofcorr.diagnosis.sums.observations import (
    Observations,
    hand_eye_columns,
    predicted_distance,
    seen_points,
)
from tofcorr.error_terms.base import Domain, Term
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.regularisation import penalties_of
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import FitOptions, refuse_missing_inputs
from tofcorr.fit.walls import name_walls
from tofcorr.geometry.rays import tangents
from tofcorr.pixels.dataset import Dataset, covered_domain, domain_from
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.numerics import by_frame
from tofcorr.simulation.hooks import FrameFacts

PER_WALL = 3
"""Parameters of a wall: two turns, radians, and a shift, metres."""


def with_numbered_walls(observations: Observations, *, fewest_poses: int = 3) -> Observations:
    """Return the observations that know which wall each frame shows, where planes are estimated.

    Recorded planes that were measured stay as they are: no wall is numbered.

    Args:
        observations: The pixels.
        fewest_poses: Fewest poses of a wall. A wall has three parameters and one pose determines
            about three, so that fewer poses tell hardly anything but where the wall is. As in
            training.

    Raises:
        CalibrationDataError: The planes are estimated, and no robot moves, or a wall is seen from
            fewer than three poses.
    """
    recording = observations.recording
    if recording.planes != "estimated":
        return observations
    if not recording.moves:
        raise CalibrationDataError(
            f"{recording.path}: its planes are estimated from the depth (recording.yaml: planes) "
            "and no robot moves: nothing but the depth itself says where they are. Measure them, "
            "or import a checkerboard."
        )
    of_frame, names = name_walls(Dataset((recording,)))
    wall = torch.from_numpy(of_frame)
    seen = observations.frame.unique()
    for number, name in enumerate(names):
        poses = len(observations.unit[seen][wall[seen] == number].unique())
        if poses < fewest_poses:
            raise CalibrationDataError(
                f"{recording.path}: its planes are estimated from the depth (recording.yaml: "
                f"planes), and '{name}' is seen from {poses} pose{'s' * (poses != 1)}; "
                f"{fewest_poses} are needed to "
                "estimate it anew. Record more, or leave its frames out."
            )
    return replace(observations, wall=wall, num_walls=len(names))


def wall_columns(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the derivative of the predicted distance by the G walls' parameters, (M, 3G)."""
    wall, frame = observations.wall, observations.frame
    assert wall is not None
    _, slope, points = seen_points(observations, tool_from_camera)
    across = by_frame(points, tangents(observations.facts.normal_world).mT, frame)
    own = -torch.cat([across, torch.ones_like(across[:, :1])], dim=1) / slope[:, None]
    shown = torch.nn.functional.one_hot(wall[frame], observations.num_walls)
    return (shown[:, :, None] * own[:, None]).flatten(1)


def with_walls_moved(observations: Observations, step: Tensor) -> Observations:
    """Return the observations after a step (3G,) of the walls; recording and facts both follow."""
    wall, facts = observations.wall, observations.facts
    if wall is None:
        return observations
    change = step.reshape(-1, PER_WALL)[wall]
    turned = facts.normal_world + (change[:, :2, None] * tangents(facts.normal_world)).sum(1)
    normal = torch.nn.functional.normalize(turned, dim=1)
    return with_planes(
        observations, replace(facts, normal_world=normal, offset=facts.offset + change[:, 2])
    )


def with_planes(observations: Observations, facts: FrameFacts) -> Observations:
    """Return the observations with the planes of other facts about the same frames."""
    if observations.wall is None:
        return observations
    planes = {"normal_world": facts.normal_world, "offset": facts.offset}
    table = replace(observations.recording.frames, **{k: v.numpy() for k, v in planes.items()})
    recording = replace(observations.recording, frames=table)
    return replace(observations, facts=replace(observations.facts, **planes), recording=recording)


def unknown_amplitude_columns(
    observations: Observations, inputs: EffectInputs, *, amplitude_error: float = 0.02
) -> Tensor:
    """Return the columns, shape (M, K), metres at one prior standard deviation.

    K is 0 where the amplitude is known.

    Args:
        observations: The pixels.
        inputs: What effects may depend on.
        amplitude_error: Prior standard deviation of the error at the root mean square of a column,
            metres. Lindner and Kolb (2007) and Fuchs and May (2007) report errors of one to three
            centimetres by amplitude.
    """
    if inputs.amplitude is not None:
        return torch.zeros(len(inputs.pixel), 0, dtype=torch.float64)
    bright = inputs.incidence_cosine * inverse_square(inputs.radial_distance)
    exposure = inputs.facts.integration_time
    if exposure is not None and bool((exposure > 0).all()):
        bright = bright * inputs.of_frame(exposure / exposure.mean())
    bright = bright / bright.square().mean().sqrt()
    forms = torch.stack([bright, bright**2, bright * (inputs.rows**2 + inputs.columns**2)], dim=1)
    forms = amplitude_error * forms / forms.square().mean(0).sqrt()
    # Four targets at most get columns of their own; all frames of rarer ones share the last.
    names = list(observations.recording.frames.target)
    common = sorted(set(names), key=lambda name: (-names.count(name), name))
    target = inputs.of_frame(torch.tensor([min(common.index(name), 3) for name in names]))
    return torch.cat([forms * (target == k)[:, None] for k in target.unique()], dim=1)


def definite_base(
    recording: Recording, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    """Return the terms that the recording can support, with every `auto` replaced, and warnings.

    Amplitude terms are left out, with a warning, where no amplitude was recorded. What else says
    `auto`, a smoothness or a time constant, is determined by the fit of `tofcorr train`. The spread
    of a fixed pattern stays open: it is estimated from the residual of the base fit.

    Args:
        recording: The recording under diagnosis.
        base: The terms asked for.

    Raises:
        CalibrationDataError: The recording lacks what another term needs; names the term.
    """
    warnings, kept = [], tuple(term for term in base.terms if "amplitude" not in term.needs)
    if recording.amplitude is None and len(kept) < len(base.terms):
        dropped = ", ".join(term.kind for term in base.terms if term not in kept)
        warnings = [
            f"{recording.path}: amplitude.npy is missing; the base model has no amplitude term "
            f"({dropped} left out). An error that depends on the amplitude cannot be named. What "
            "could be one, by distance, incidence, exposure and place in the image, is not counted "
            "for other effects; on a patterned target it also raises the noise floor, an upper "
            "bound therefore."
        ]
        base = ErrorModelOptions(terms=kept)
    dataset, columns = Dataset((recording,)), base.with_columns()
    refuse_missing_inputs(dataset, base)
    if not any(term.is_open(option) for term in columns.terms for option in term.found_in_data):
        return base, warnings
    frames = np.arange(dataset.num_frames)
    found = fit(dataset, frames, FitOptions(model=columns), covered_domain(dataset, frames))
    definite = iter(found.options.terms)
    terms = tuple(next(definite) if term.has_columns else term for term in base.terms)
    return ErrorModelOptions(terms=terms), warnings


def supported_base(
    recording: Recording, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    """Return the terms whose inputs a recording has, and the kinds of the others."""
    dataset, kept, lacking = Dataset((recording,)), [], []
    for term in base.terms:
        try:
            refuse_missing_inputs(dataset, ErrorModelOptions(terms=(term,)))
        except CalibrationDataError:
            lacking.append(term.kind)
        else:
            kept.append(term)
    return ErrorModelOptions(terms=tuple(kept)), lacking


class BaseModel:
    """Hand-eye transform, estimated walls and error model, linear around a start.

    The walls are where the observations have them. Measured planes are no part of the model.

    Args:
        observations: The recording; its ranges scale the variables of the error terms.
        options: Terms of the error model; a fixed pattern among them has no columns here.
        hand_eye_free: Whether the hand-eye transform is estimated.

    Attributes:
        domain: The ranges of the recording's variables.

    Class attributes:
        hand_eye_sd: Prior standard deviations of the hand-eye transform, metres and radians.
        wall_sd: The same of an estimated wall: two turns, radians, and a shift, metres.
        error_sd: The same of the coefficients of error terms, metres. All are chosen so wide that
            they matter only in directions without data.

    Raises:
        CalibrationDataError: The recording lacks what a term needs.
    """

    hand_eye_sd: ClassVar = (0.3, 0.3, 0.3, 0.5, 0.5, 0.5)
    wall_sd: ClassVar = (0.5, 0.5, 0.3)
    error_sd: ClassVar = 1.0

    def __init__(
        self, observations: Observations, options: ErrorModelOptions, *, hand_eye_free: bool
    ) -> None:
        self.observations, self.options = observations, options
        self.hand_eye_free = hand_eye_free
        self.domain = domain_of(observations)
        self.error_model = ErrorModel(options, self.domain)

    def on(self, observations: Observations) -> "BaseModel":
        """Return the same model, scaled alike, on other pixels or walls."""
        other = copy(self)
        other.observations = observations
        return other

    @property
    def terms(self) -> list[Term]:
        """All terms with columns, in their order."""
        return self.error_model.terms()

    @property
    def groups(self) -> set[str]:
        """Groups of the terms, as in `Term.group`."""
        return {term.group for term in self.terms}

    @property
    def num_hand_eye(self) -> int:
        """Number of columns of the hand-eye transform."""
        return 6 if self.hand_eye_free else 0

    @property
    def num_geometry(self) -> int:
        """Number of columns of hand-eye transform and estimated walls; they come first."""
        return self.num_hand_eye + PER_WALL * self.observations.num_walls

    @property
    def num_columns(self) -> int:
        """Number of columns."""
        return self.num_geometry + len(self.error_model.symbols())

    def moved(self, step: Tensor) -> "BaseModel":
        """Return the model after a step of the geometry columns, with its walls moved."""
        walls = step[self.num_hand_eye : self.num_geometry]
        return self.on(with_walls_moved(self.observations, walls))

    def prior_precision(self, total_weight: float) -> Tensor:
        r"""Return the precision of the coefficients' priors, with curves held smooth, (K, K).

        To the diagonal of their variances comes :math:`\sum \lambda F^T F`: a strength weighs
        roughness against the mean square, as in training.

        Args:
            total_weight: Sum of the weights of the residuals.
        """
        hand_eye = self.hand_eye_sd[: self.num_hand_eye]
        walls = self.wall_sd * self.observations.num_walls
        sd = [*hand_eye, *walls, *[self.error_sd] * (self.num_columns - self.num_geometry)]
        matrix = torch.diag(torch.tensor(sd, dtype=torch.float64) ** -2)
        for penalty in penalties_of(self.error_model):
            roughness = penalty.factor.T @ penalty.factor
            matrix[self.num_geometry :, self.num_geometry :].add_(
                roughness, alpha=total_weight * float(penalty.strength)
            )
        return matrix

    def error_columns(self, distance: Tensor) -> Tensor:
        """Return constant and terms at predicted distances (M,), metres, shape (M, K)."""
        observations = self.observations
        amplitude, width = observations.amplitude, observations.recording.camera.width
        pixels = Pixels(
            distance,
            torch.zeros_like(distance) if amplitude is None else amplitude,
            (observations.pixel // width).double(),
            (observations.pixel % width).double(),
            observations.conditions[observations.frame],
        )
        return self.error_model.columns_at(pixels).detach().T

    def residual(self, tool_from_camera: Tensor, coefficients: Tensor) -> Tensor:
        """Return measured less fitted distance with coefficients of the terms, (M,), metres."""
        distance = predicted_distance(self.observations, tool_from_camera)
        error = self.error_columns(distance) @ coefficients
        return self.observations.measured - distance - error

    def columns(self, tool_from_camera: Tensor) -> Tensor:
        """Return all columns around a hand-eye transform (4, 4), shape (M, K)."""
        return self.linearised(tool_from_camera)[1]

    def linearised(self, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
        """Return the predicted distance, (M,), metres, and all columns, (M, K)."""
        observations, parts = self.observations, []
        distance, columns = hand_eye_columns(observations, tool_from_camera)
        if self.hand_eye_free:
            parts.append(columns)
        if observations.num_walls:
            parts.append(wall_columns(observations, tool_from_camera))
        # Rows (K, M) are filled several times faster than columns.
        return distance, torch.cat([part.T for part in (*parts, self.error_columns(distance))]).T


def domain_of(observations: Observations, outside_share: float = 0.0005) -> Domain:
    """Return the ranges of the recording's variables.

    Args:
        observations: The pixels.
        outside_share: Share of the values below and above a range, so that single gross errors do
            not stretch it. Chosen; training takes 0.001.
    """
    recording = observations.recording
    return domain_from(
        recording.camera,
        observations.measured,
        observations.amplitude,
        recording.modulation_frequency,
        observations.conditions,
        outside_share=outside_share,
        method="nearest",
    )
