"""The same fit by other people's solvers: SciPy, PyPose, and torch's L-BFGS by autograd.

Every peer gets the same frames and the same start, and fits the same model over all pixels.
"""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.estimation.objective import Parameters
from tofcorr.geometry import se3


class PeerFit(NamedTuple):
    """Where a peer ended.

    Attributes:
        loss: Sum of squared residuals, square metres.
        tool_from_camera: Shape (4, 4).
        note: What should be known about the figure.
    """

    loss: float
    tool_from_camera: Tensor
    note: str = ""


class PixelColumns(NamedTuple):
    """The used pixels of all frames as flat arrays: what a residual needs.

    Attributes:
        rays: Viewing rays, shape (V, 3).
        distance: Measured distances, shape (V,), metres.
        basis: The error model's columns, shape (V, K).
        frame: The frame of each pixel, shape (V,).
    """

    rays: np.ndarray
    distance: np.ndarray
    basis: np.ndarray
    frame: np.ndarray


def pixel_columns(batch: FrameBatch, error: ErrorModel, rays: Tensor) -> PixelColumns:
    """Lay the used pixels out flat."""
    frame, row, column = torch.nonzero(batch.valid, as_tuple=True)
    distance = batch.radial_distance[batch.valid]
    amplitude = distance if batch.amplitude is None else batch.amplitude[batch.valid]
    with torch.no_grad():
        signal = [term.basis(distance, amplitude) for term in error.signal_terms]  # type: ignore[operator]
        pixel = [term.basis(row.double(), column.double()) for term in error.pixel_terms]  # type: ignore[operator]
    basis = torch.cat([torch.ones_like(distance)[None], *signal, *pixel]).T
    return PixelColumns(
        rays[row, column].numpy(), distance.numpy(), basis.contiguous().numpy(), frame.numpy()
    )


def scipy_fit(
    batch: FrameBatch, error: ErrorModel, rays: Tensor, start: Parameters
) -> tuple[PeerFit, np.ndarray]:
    """Fit with `scipy.optimize.least_squares(method="lm")` and the analytic Jacobian.

    Returns:
        The fit, and its covariance (P, P) from the final Jacobian.
    """
    columns = pixel_columns(batch, error, rays)
    normal, offset = batch.normal_tool.numpy(), batch.offset_tool.numpy()
    first = start.tool_from_camera.numpy()

    def unpack(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return first @ se3.exp(torch.from_numpy(x[:6])).numpy(), x[6:]

    def parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        transform, coefficients = unpack(x)
        normal_camera = normal @ transform[:3, :3]
        cosine = np.einsum("vk,vk->v", columns.rays, normal_camera[columns.frame])
        corrected = columns.distance - columns.basis @ coefficients
        return transform, normal_camera, cosine, corrected

    def residual(x: np.ndarray) -> np.ndarray:
        transform, _, cosine, corrected = parts(x)
        return cosine * corrected + (normal @ transform[:3, 3] + offset)[columns.frame]

    def jacobian(x: np.ndarray) -> np.ndarray:
        _, normal_camera, cosine, corrected = parts(x)
        _, turn = _exp_derivative(x[:6])
        a = normal_camera[columns.frame]
        shift = a @ turn[:3]
        spin = np.cross(columns.rays * corrected[:, None], a) @ turn[3:]
        return np.hstack([shift + spin, -cosine[:, None] * columns.basis])

    x0 = np.concatenate([np.zeros(6), start.coefficients.numpy()])
    found = least_squares(  # SciPy's stubs know no callable Jacobian.
        residual,
        x0,
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-12,
        gtol=1e-15,
    )
    transform, _ = unpack(found.x)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / len(found.fun)
    note = f"{found.nfev} evaluations"
    return PeerFit(2 * found.cost, torch.from_numpy(transform), note), covariance


def _exp_derivative(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return exp and the body-frame derivative D with exp(x + d) = exp(x) exp(D d), (6, 6)."""
    x = torch.from_numpy(twist.copy())
    here = se3.exp(x)

    def body(y: Tensor) -> Tensor:
        moved = se3.inverse(here) @ se3.exp(y)
        rotation = moved[:3, :3]
        spin = torch.stack([rotation[2, 1], rotation[0, 2], rotation[1, 0]])
        return torch.cat([moved[:3, 3], spin])

    derivative = torch.autograd.functional.jacobian(body, x)
    return here.numpy(), derivative.numpy()  # type: ignore[union-attr]


def torch_fit(
    batch: FrameBatch, error: ErrorModel, rays: Tensor, start: Parameters, max_iterations: int
) -> PeerFit:
    """Fit with `torch.optim.LBFGS` by autograd over all pixels, as the equations are written."""
    model, distance, amplitude = _module(batch, error, start)
    optimiser = torch.optim.LBFGS(
        [p for p in model.parameters() if p.requires_grad],
        max_iter=max_iterations,
        max_eval=2 * max_iterations,
        history_size=20,
        tolerance_grad=1e-12,
        tolerance_change=1e-15,
        line_search_fn="strong_wolfe",
    )
    evaluations = 0

    def closure() -> Tensor:
        nonlocal evaluations
        evaluations += 1
        optimiser.zero_grad()
        loss = _loss(model, batch, distance, amplitude, rays)
        loss.backward()
        return loss

    optimiser.step(closure)  # type: ignore[arg-type]
    loss = float(_loss(model, batch, distance, amplitude, rays))
    note = f"{evaluations} evaluations of at most {2 * max_iterations}"
    return PeerFit(loss, model.hand_eye().detach(), note)


def pypose_fit(batch: FrameBatch, error: ErrorModel, rays: Tensor, start: Parameters) -> PeerFit:
    """Fit with PyPose's `LM`, whose dense Jacobian limits it to few pixels: pass a small batch."""
    pypose: Any = import_module("pypose")
    columns = pixel_columns(batch, error, rays)
    flat = [torch.from_numpy(part) for part in columns]
    normal, offset = batch.normal_tool, batch.offset_tool

    class Residual(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            pose = pypose.mat2SE3(start.tool_from_camera)
            self.pose: Any = pypose.Parameter(pose)
            self.coefficients = torch.nn.Parameter(start.coefficients.clone())

        def forward(self, frame: Tensor) -> Tensor:
            corrected = flat[1] - flat[2] @ self.coefficients
            points = self.pose.Act(flat[0] * corrected[:, None])
            return (points * normal[frame]).sum(-1) + offset[frame]

    model: Any = Residual()
    strategy = pypose.optim.strategy.Adaptive()
    optimiser = pypose.optim.LM(model, strategy=strategy, vectorize=True)
    last, loss = float("inf"), float("inf")
    for _ in range(50):
        loss = float(optimiser.step(flat[3]))
        if last - loss <= 1e-12 * loss:
            break
        last = loss
    se3_matrix = model.pose.detach().matrix()
    return PeerFit(loss, se3_matrix, f"{len(flat[1])} pixels")


def _module(
    batch: FrameBatch, error: ErrorModel, start: Parameters
) -> tuple[CalibrationModel, Tensor, Tensor | None]:
    error.set_coefficient_vector(start.coefficients)
    model = CalibrationModel(error, HandEye(start.tool_from_camera))
    distance = torch.where(batch.valid, batch.radial_distance, 1.0)
    return model, distance, batch.amplitude


def _loss(
    model: CalibrationModel,
    batch: FrameBatch,
    distance: Tensor,
    amplitude: Tensor | None,
    rays: Tensor,
) -> Tensor:
    residual = model.residual(distance, amplitude, rays, batch.normal_tool, batch.offset_tool)
    return torch.where(batch.valid, residual, 0.0).square().sum()
