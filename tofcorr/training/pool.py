r"""`tofcorr.pool`: what several cameras of one type have in common, as the prior of the next one.

The coefficients of unit u are :math:`\theta_u \sim N(\mu, B)`, and its calibration knows them with
the covariance :math:`V_u`. Mean and scatter between units are those of the marginal likelihood
:math:`\hat\theta_u \sim N(\mu, B + V_u)`, by expectation maximisation (empirical Bayes): what is
left of the scatter beyond each calibration's own uncertainty. Few units say little of B, so that
something is believed before: one more unit of the scatter that all coefficients have on average,
and as many units as there are coefficients for their not being correlated.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path

import torch
from pydantic import Field
from torch import Tensor

from tofcorr.correction.state import (
    STATE_FILE,
    Float64,
    load_calibration,
    read_values,
    save_values,
)
from tofcorr.digits import aligned
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.linear import inverse
from tofcorr.estimation.moments import Parameters
from tofcorr.files import refuse_damaged
from tofcorr.fit.known import PriorKnowledge, known_of
from tofcorr.options import Options, refused_in_words
from tofcorr.pixels.dataset import Dataset, recorded_hand_eye
from tofcorr.training.calibration import TrainingOptions

_FORMAT, _WHAT = "tofcorr-camera-type", "a camera type that tofcorr pool wrote"
# Steps of the expectation maximisation. Between 2 and 20 units it settles in tens of them.
_STEPS = 200


class CameraType(Options):
    """What cameras of one type have in common; its `repr` is what the command prints.

    Attributes:
        error_model: The terms.
        domain: The ranges that scale the variables: of all units.
        mean: Of the coefficients, shape (K,), metres.
        covariance: Of the coefficients of the next unit, shape (K, K), square metres: scatter
            between units, and uncertainty of the mean.
        units: The runs.
    """

    error_model: ErrorModelOptions
    domain: Domain
    mean: Float64
    covariance: Float64
    units: tuple[str, ...] = Field(min_length=2)

    def known(self, data: Dataset) -> PriorKnowledge:
        """Return what is known of the next unit.

        Args:
            data: Its recordings.
        """
        own = Parameters(recorded_hand_eye(data), self.mean, hand_eye_is_free=False)
        terms, domain = self.error_model, self.domain
        return PriorKnowledge(
            options=terms, domain=domain, parameters=own, covariance=self.covariance
        )

    def __repr__(self) -> str:
        """Return how many units there are, and how far they scatter."""
        constant, *others = (1e3 * self.covariance.diagonal().sqrt()).tolist()
        scatter = f"the constant scatters by {constant:.1f} mm between them"
        most = f", the other coefficients by up to {max(others):.1f} mm" if others else ""
        return f"A camera type from {len(self.units)} units: {scatter}{most}."

    @property
    def details(self) -> str:
        """The same, and mean and scatter of each coefficient."""
        symbols = ErrorModel(self.error_model, self.domain).symbols()
        both = zip(self.mean.tolist(), self.covariance.diagonal().sqrt().tolist(), strict=True)
        cells = [(f"{1e3 * mean:.2f}", f"{1e3 * spread:.2f}") for mean, spread in both]
        rows = [(name, *cell) for name, cell in zip(symbols, cells, strict=True)]
        return "\n".join([repr(self), *aligned([("coefficient", "mean, mm", "± mm"), *rows])])


def pool(runs: Sequence[Path | str], *, out: Path | str | None = None) -> CameraType:
    """Find what the runs of several cameras of one type have in common.

    Args:
        runs: A run folder of each unit; at least two.
        out: File to write, for `prior` of `tofcorr.train` and `tofcorr.update`; an older one is
            replaced. None writes nothing.

    Raises:
        ConfigError: There are fewer than two runs.
        CalibrationDataError: A folder holds no run, or none that can be carried on; the runs are
            of other terms or image sizes; or the file cannot be written.
    """
    if len(runs) < 2:
        raise ConfigError(f"A camera type needs runs of at least 2 units, got {len(runs)}.")
    paths = [Path(run) for run in runs]
    states = [load_calibration(path / STATE_FILE) for path in paths]
    first = states[0]
    for path, state in zip(paths, states, strict=True):
        if not state.error_model.same_coefficients(first.error_model):
            said = f"its model {state.name} has other terms than {first.name} of {paths[0]}"
            raise CalibrationDataError(f"{path}: {said}; train all units with one configuration.")
        if state.depth_kind != first.depth_kind:
            said = f"its depth is {state.depth_kind}, that of {paths[0]} {first.depth_kind}"
            raise CalibrationDataError(f"{path}: {said}; one type has one kind of depth.")
    domain = reduce(Domain.joined, (state.domain for state in states))
    units = [
        replace(known_of(state, path, moves=False)[0], options=first.error_model).on(domain)
        for path, state in zip(paths, states, strict=True)
    ]
    means = torch.stack([unit.parameters.coefficients for unit in units])
    mean, covariance = between_units(means, torch.stack([unit.covariance for unit in units]))
    found = CameraType(
        error_model=first.error_model,
        domain=domain,
        mean=mean,
        covariance=covariance,
        units=tuple(path.name for path in paths),
    )
    if out is not None:
        save_values(out, _FORMAT, found.model_dump(), CalibrationDataError)
    return found


def between_units(means: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of units, and the covariance of the next unit about it.

    Args:
        means: Estimates of each unit, shape (U, K).
        own: Their covariances, shape (U, K, K).
    """
    units, size = means.shape

    def about(between: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean, its covariance, and the precision of each estimate about it."""
        precision = inverse(between + own)
        of_mean = inverse(precision.sum(dim=0))
        return of_mean @ (precision @ means[..., None]).sum(dim=0)[:, 0], of_mean, precision

    between = (means - means.mean(dim=0)).square().mean(dim=0).diag() + own.mean(dim=0)
    for _ in range(_STEPS):
        mean, _, precision = about(between)
        gain = between @ precision
        off = (gain @ (means - mean)[..., None])[..., 0]
        scatter = off.T @ off + (between - gain @ between).sum(dim=0)
        each = scatter.diagonal()
        alone = (each + each.median() / units) / units
        between = (scatter + size * alone.diag()) / (units - 1 + size)
    mean, of_mean, _ = about(between)
    return mean, between + of_mean


def load_type(path: Path | str, options: TrainingOptions) -> CameraType:
    """Read a file that `pool` wrote, for a training of the same terms.

    Raises:
        CalibrationDataError: There is no such file, it is damaged, or it is another one.
        ConfigError: The training is of other terms.
    """
    path = Path(path)
    refuse_damaged(path, _WHAT)
    values = read_values(path, _FORMAT)
    if values is None:
        raise CalibrationDataError(f"{path}: is not {_WHAT}.")
    with refused_in_words(CameraType, str(path), CalibrationDataError):
        found = CameraType.model_validate(values)
    if not found.error_model.same_coefficients(options.model):
        kinds = ", ".join(term.kind for term in found.error_model.terms)
        raise ConfigError(f"{path}: its model has other terms ({kinds}) than {options.name}.")
    return found
