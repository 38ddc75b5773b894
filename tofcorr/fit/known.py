r"""What earlier calibrations say of a camera, carried into the next fit as a Gaussian prior.

It is the posterior of one calibration, or what several units of a camera type have in common:
:math:`\theta \sim N(\theta_0, S)` for a step of the hand-eye transform and the coefficients, or for
the coefficients alone. Coefficients belong to ranges that scale the model's variables, so it is
taken to the ranges of the new fit by a linear map.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModelOptions, columns_on
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import Parameters, Prior
from tofcorr.estimation.uncertainty import PRIOR_SIGMA


@dataclass(frozen=True, kw_only=True)
class PriorKnowledge:
    """A Gaussian belief about the unknowns of a model.

    Attributes:
        options: The model's terms; nothing is left to find in data.
        domain: The ranges that scale its variables.
        parameters: The mean; its hand-eye transform is part of the belief only if it is free.
        covariance: Of a step from the mean, shape (P, P).
        variance: Least effective variance of a residual, in the unit of the loss; 0: unknown.
    """

    options: ErrorModelOptions
    domain: Domain
    parameters: Parameters
    covariance: Tensor
    variance: float = 0.0

    def on(self, domain: Domain) -> "PriorKnowledge":
        """Return the same for other ranges.

        Raises:
            CalibrationDataError: A term has other functions there.
        """
        change = columns_on(self.options, self.domain, domain).T
        coefficients = change @ self.parameters.coefficients
        whole = torch.block_diag(torch.eye(self.parameters.twist_size).to(change), change)
        parameters = replace(self.parameters, coefficients=coefficients)
        covariance = whole @ self.covariance @ whole.T
        return replace(self, domain=domain, parameters=parameters, covariance=covariance)

    def towards(self, domain: Domain) -> "PriorKnowledge":
        """Return the same for ranges that hold others as well, where its terms can be widened."""
        wider = self.domain.joined(domain)
        with suppress(CalibrationDataError):  # Splines keep their knots, and end where they did.
            return self.on(wider)
        return self

    def of_coefficients(self) -> "PriorKnowledge":
        """Return what it says of the coefficients alone."""
        twist = self.parameters.twist_size
        parameters = replace(self.parameters, hand_eye_is_free=False)
        return replace(self, parameters=parameters, covariance=self.covariance[twist:, twist:])

    def prior(self, guess: Parameters) -> Prior:
        """Return it as a prior of a fit.

        Args:
            guess: Whose hand-eye transform stands where the belief has none.
        """
        centre = self.parameters
        if not centre.hand_eye_is_free:
            centre = replace(guess, coefficients=centre.coefficients)
        root = torch.linalg.inv(torch.linalg.cholesky(self.covariance))
        factor = torch.nn.functional.pad(root, (centre.size - len(root), 0))
        return Prior(centre, factor, self.variance, ["earlier calibration"] * len(root))


def known_of(
    state: CalibrationState, path: Path, *, moves: bool
) -> tuple[PriorKnowledge, str | None]:
    """Return what a calibration knows.

    Args:
        state: The calibration.
        path: Of its run, for messages.
        moves: Whether the hand-eye transform is estimated further on.

    Returns:
        The belief; and a sentence on what an older file lacks of it, None if it is whole.

    Raises:
        CalibrationDataError: It holds no covariance, or a map of the pixels or a network, of which
            no uncertainty is known.
    """
    reason = None
    if state.residual is not None or state.fixed_pattern is not None:
        reason = "its model has a residual network or a fixed pattern, which cannot be carried on"
    elif state.covariance is None:
        reason = "it holds no covariance of its coefficients"
    if reason is not None:
        raise CalibrationDataError(f"{path}: {reason}; train on all recordings together instead.")
    joint, said, coefficients = state.joint_covariance, None, state.covariance
    if joint is None:
        assert coefficients is not None
        joint, accuracy = coefficients, state.hand_eye_accuracy
        said = "The run is of an older version: hand-eye and coefficients count as independent."
        if state.hand_eye_estimated:
            errors = torch.full((2, 3), PRIOR_SIGMA, dtype=torch.float64)
            if accuracy is not None and not accuracy.undetermined:
                millimetres, degrees = accuracy.translation_se_mm, accuracy.rotation_se_deg
                errors = torch.tensor([millimetres, degrees], dtype=torch.float64)
                errors = torch.stack([errors[0] / 1e3, torch.deg2rad(errors[1])])
            turn = torch.block_diag(*[state.tool_from_camera[:3, :3]] * 2)
            own = turn.T @ errors.flatten().square().diag() @ turn
            joint = torch.block_diag(own, coefficients)
    own = Parameters(state.tool_from_camera, state.coefficients, state.hand_eye_estimated)
    known = PriorKnowledge(
        options=state.error_model,
        domain=state.domain,
        parameters=own,
        covariance=joint,
        variance=state.residual_variance or 0.0,
    )
    return (known if moves else known.of_coefficients()), said
