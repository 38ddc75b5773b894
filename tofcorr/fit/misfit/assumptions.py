r"""How far the hand-eye transform would move if what a fit takes as given were a little off.

No residual shows a small error of the intrinsics or of the planes: the hand-eye transform and the
error terms absorb it. So standard errors cannot hold it. With the model's columns :math:`X`, and
:math:`z`, what the error does to the residuals, the transform moves by
:math:`-(X^\top X)^{-1} X^\top z`.
"""

import math

import torch
from torch import Tensor

from tofcorr.estimation.linear import Curvature
from tofcorr.fit.misfit.assumption import Assumption
from tofcorr.fit.misfit.pixels import MisfitPixels
from tofcorr.fit.misfit.prior_share import prior_by_share
from tofcorr.fit.misfit.probes import moved_rays
from tofcorr.fit.result import Fit
from tofcorr.geometry.camera import CameraIntrinsics

# Sizes of the errors: of the focal length, without unit; of the principal point, pixels; of the
# planes, metres and radians. Chosen: such ones remain after a careful calibration of the lens, and
# of a wall by touching it.
_FOCAL, _CENTRE, _PLANE, _TILT = 1e-3, 1.0, 1e-3, math.radians(0.1)


def assumptions(seen: MisfitPixels, fit: Fit, camera: CameraIntrinsics) -> tuple[Assumption, ...]:
    """Return what errors of the intrinsics and of measured planes would do.

    Args:
        seen: Some pixels beside the fitted model.
        fit: The fitted model, its hand-eye transform estimated.
        camera: As recorded.
    """
    (fx, _, _), (_, fy, _), _ = camera.matrix
    errors = [
        ("focal_length", "focal length 0.1 % longer", _longer(seen)),
        ("principal_point_right", "principal point 1 px further right", _shifted(seen, 0, fx)),
        ("principal_point_down", "principal point 1 px further down", _shifted(seen, 1, fy)),
    ]
    if not seen.walls_estimated:
        farther = torch.full_like(seen.residual, _PLANE)
        errors.append(("plane_offset", "d of all planes 1 mm larger", farther))
    columns = torch.stack([column for _, _, column in errors], dim=1)
    found = [
        Assumption(name, words, twist)
        for (name, words, _), twist in zip(errors, _moved(seen, fit, columns).T, strict=True)
    ]
    if not seen.walls_estimated:
        turned = _worst(_moved(seen, fit, _TILT * seen.on_wall))
        found.append(Assumption("plane_tilt", "all planes turned by 0.1 deg", turned))
    return tuple(found)


def _worst(twists: Tensor) -> Tensor:
    """Return what a turn does about the axis where the camera moves most, of two columns (6, 2)."""
    axes = torch.linalg.svd(twists[:3], full_matrices=False).Vh
    return twists @ axes[0]


def _longer(seen: MisfitPixels) -> Tensor:
    """Return what a longer focal length does to the residuals, (M,): rays come nearer the axis."""
    return -_FOCAL * moved_rays(seen, lambda x, y, _: (x, y))


def _shifted(seen: MisfitPixels, axis: int, focal: float) -> Tensor:
    """Return what a principal point further along an axis does: rays move the other way."""
    step = -_CENTRE / focal

    def move(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
        del y, square
        moved, still = torch.full_like(x, step), torch.zeros_like(x)
        return (moved, still) if axis == 0 else (still, moved)

    return moved_rays(seen, move)


def _moved(seen: MisfitPixels, fit: Fit, columns: Tensor) -> Tensor:
    """Return how far the hand-eye transform moves by each column, shape (6, K)."""
    weighted = seen.jacobian * seen.weight.clamp(min=0)[:, None]
    hessian = weighted.T @ seen.jacobian
    hessian = hessian + prior_by_share(seen, fit, len(hessian)).hessian
    return -(Curvature(hessian).inverse @ (weighted.T @ columns))[:6]
