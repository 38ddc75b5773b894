"""Hand-eye transforms from which the base fit starts."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.simulator_error import SimulatorError
from tofcorr.geometry import se3
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.geometry.rays import ray_directions

# The closed form is no start if a singular value of its matrix is below this. A rotation has only
# ones; chosen with room for noise.
_LEAST_SINGULAR_VALUE = 0.2


def first_guesses(observations: Observations, simulator: SimulatorError | None) -> list[Tensor]:
    """Return hand-eye transforms to start from; the first is the one to hold where none is free."""
    recording = observations.recording
    own = torch.eye(4, dtype=torch.float64)
    if recording.moves:
        own = torch.from_numpy(recording.tool_from_camera)
    return [own] if simulator is None else [simulator.tool_from_camera, own]


def closed_form(observations: Observations) -> list[Tensor]:
    """Solve n . (R D v + t) + d = 0 for the entries of R and t, then make R a rotation.

    It serves as a start only, because its regressors contain the measured distance.
    """
    facts = observations.facts
    frame = observations.frame
    rays = ray_directions(observations.recording.camera).reshape(-1, 3)[observations.pixel]
    points = rays * observations.measured[:, None]
    normal, offset = plane_in_frame(facts.normal_world, facts.offset, facts.world_from_tool)
    normal, offset = normal[frame], offset[frame]
    design = torch.cat([(normal[:, :, None] * points[:, None, :]).flatten(1), normal], dim=1)
    solved = torch.linalg.lstsq(design, -offset[:, None], driver="gelsd").solution[:, 0]
    u, values, vt = torch.linalg.svd(solved[:9].reshape(3, 3))
    if not bool(values.isfinite().all()) or float(values[-1]) < _LEAST_SINGULAR_VALUE:
        return []
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))]).double()) @ vt
    height = offset + (normal * (points @ rotation.T)).sum(1)
    shift = torch.linalg.lstsq(normal, -height[:, None], driver="gelsd").solution[:, 0]
    return [se3.assemble(rotation, shift)]


def quarter_turns(guess: Tensor) -> list[Tensor]:
    """Return a hand-eye transform turned about the optical axis by one, two and three quarters."""
    turns = []
    for quarter in (1, 2, 3):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[5] = quarter * torch.pi / 2
        turns.append(guess @ se3.exp(twist))
    return turns
