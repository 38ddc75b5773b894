"""Fits several cameras together: on walls that they share, and on a robot with errors of its own.

Each camera is fitted alone first. Then the unknowns of all cameras, of the walls and of the robot's
joints take damped Gauss-Newton steps together (`estimation/joint.py`). Each camera's loss is
divided by the effective variance of its residuals, so that a noisy camera counts less. Cameras that
record at one pose of the robot share its error: they are one unit of the jackknife.

*What a joint's offset cannot be told from.* The offset of the last joint is the same as a turn of
the camera about its axis; that of the first joint the same as a turn of all walls, if these are
unknown. Such an offset stays zero, and is named; hand-eye transform or walls contain it. Errors of
lengths of links are offsets too. Whether one is determined is asked as of a joint, which knows
nothing of it before; then the maker's tolerance is its prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import STANDSTILL
from tofcorr.data.table import TABLE_FILE
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.joint import Together, View, estimate_together
from tofcorr.estimation.linear import NormalEquations, solvable
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import Planes, marginal
from tofcorr.estimation.solvers import minimise
from tofcorr.estimation.uncertainty import PRIOR_SIGMA, Covariance, effective_variance, jackknife
from tofcorr.fit.fitting import (
    expected_moments,
    hand_eye_alone,
    hold,
    known_noise,
    on_walls,
    prepare,
    refuse_diverged,
    step_off_noise,
    with_pattern,
    within_loss,
)
from tofcorr.fit.problem import Core, Fit, Problem, Shift
from tofcorr.fit.walls import lone_walls
from tofcorr.fit.weighting import PixelWeights
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm, PosedArm
from tofcorr.pixels.dataset import Dataset, Frames, thread_number

OFFSET_SIGMA = 0.02
"""Standard deviation of the prior on a joint's offset, radians (1.1 degrees) or metres. Chosen: the
zero marks of arms are right to a tenth of it. It moves nothing that poses determine."""
# Largest difference of tip_from_tool between frames, metres or radians. Chosen: controllers that
# know the errors of their own arm report poses some millimetres off the description of its type.
_SAME_TOOL = 0.02


@dataclass(frozen=True, kw_only=True)
class _Camera:
    """One camera: what was recorded, what is fitted, and what was found."""

    recorded: Dataset
    problem: Problem
    core: Core
    weights: PixelWeights | None
    noise: DistanceNoise | None
    view: View


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFit:
    """Cameras that were fitted together.

    Attributes:
        fits: The fit of each camera.
        problems: What each camera was fitted to, on the walls and poses found.
        together: All unknowns, as found.
        covariance: Of all unknowns, in the order of `together`; right on average, where that of
            each of the `fits` is on the safe side, as of any training.
        shared: The numbers of each camera's walls among all walls; None: the walls are known.
        arm: The robot's arm; None: its poses are right.
        chosen: Places of the joints and lengths whose offsets were estimated.
        undetermined: Of the others, by place: what the offset cannot be told from.
    """

    fits: tuple[Fit, ...]
    problems: tuple[Problem, ...]
    together: Together
    covariance: Covariance
    shared: tuple[Tensor, ...] | None
    arm: Arm | None
    chosen: tuple[int, ...]
    undetermined: dict[int, str]

    def between(self, first: int, second: int) -> tuple[Tensor, Tensor]:
        """Return first_from_second (4, 4) of two cameras, and the covariance of its twist (6, 6).

        A twist moves the transform T to T exp(twist): it is in the axes of the second camera.
        """
        cameras, places = self.together.cameras, self.together.places()
        transforms = [one.tool_from_camera for one in cameras]
        found = se3.inverse(transforms[first]) @ transforms[second]
        slopes = {first: -adjoint(se3.inverse(found)), second: torch.eye(6).to(found)}
        # The first camera around a cell is where it is by definition.
        free = [one for one in slopes if cameras[one].hand_eye_is_free]
        both = torch.cat([places[one][:6] for one in free])
        matrix = self.covariance.matrix[both][:, both]
        left = [self.fits[one].hand_eye_covariance for one in free]
        scatter = [self.fits[one].covariance.matrix[:6, :6] for one in free]
        # What is left of the noise's shift and of errors that the models lack is each camera's own.
        matrix = matrix + torch.block_diag(*left) - torch.block_diag(*scatter)
        slope = torch.cat([slopes[one] for one in free], dim=1)
        return found, slope @ matrix @ slope.T


def adjoint(transform: Tensor) -> Tensor:
    """Return A (6, 6) with T exp(twist) T^-1 = exp(A twist)."""
    return se3.vee(transform @ se3.GENERATORS.to(transform) @ se3.inverse(transform)).T


def fit_together(problems: Sequence[Problem], arm: Arm | None = None) -> JointFit:
    """Fit several cameras together.

    Args:
        problems: What to fit, a camera each; without residual networks. Walls are estimated in all
            of them or in none.
        arm: The robot that carries them; offsets of its joints, and of its lengths if it has some,
            are estimated as well. None: the recorded poses are right.

    Raises:
        CalibrationDataError: A camera cannot be fitted alone, or its recordings lack joint angles.
        ConfigError: The arm is not that of the recordings.
    """
    with thread_number(1):
        joints = range(0 if arm is None else len(arm.names))
        cameras = [_alone(problem, arm, joints) for problem in problems]
        variances = [effective_variance(one.core.moments, _found(one)) for one in cameras]
        planes, shared = _shared_walls([one.problem for one in cameras])
        for k, one in enumerate(cameras):
            walls = one.view.walls
            if shared is not None:
                walls = replace(walls, index=shared[k][walls.index])
            weight = variances[0] / variances[k]
            view = replace(one.view, walls=walls, weight=weight, moments=one.core.moments)
            cameras[k] = replace(one, view=view)
        zero = torch.zeros(len(joints), dtype=torch.float64)
        # Nothing is known of lengths either, until it is known which are determined.
        wide = torch.full_like(zero, OFFSET_SIGMA)
        together = Together.start([_found(one) for one in cameras], planes, zero, wide)
        undetermined = _undetermined(cameras, together, variances[0], arm)
        chosen = tuple(k for k in joints if k not in undetermined)
        sigma = wide if arm is None else wide.minimum(arm.tolerance)[list(chosen)]
        arms = [one.view.arm and replace(one.view.arm, chosen=chosen) for one in cameras]
        cameras = [
            replace(one, view=replace(one.view, arm=own))
            for one, own in zip(cameras, arms, strict=True)
        ]
        together = Together.start(together.cameras, planes, zero[: len(chosen)], sigma)
        coupled = shared is not None and len(torch.cat(shared).unique()) < sum(map(len, shared))
        if coupled or chosen:
            prior = _prior(cameras, together, variances[0], smoothness=True)[0]
            together = estimate_together([one.view for one in cameras], together, prior)
            cameras, together = _held(cameras, together, variances[0], shared)
        optima, units = together.cameras, shared_poses([one.problem for one in cameras])
        views = [one.view for one in cameras]
        each = together.all_equations(views).by_pose(torch.cat(units))
        prior, scores = _prior(cameras, together, variances[0])
        hessian = each.total().plus(prior).hessian
        own, shared_too = (jackknife(each, hessian, scores, unbiased=k) for k in (False, True))
        cameras, together, shifts = _off_noise(cameras, together, prior, shared)
        fits = [
            Fit(
                **vars(one.core),
                model=with_pattern(one.problem, one.core),
                domain=one.problem.domain,
                optimum=optimum,
                hand_eye_only=hand_eye_alone(one.problem, one.core.moments),
                covariance=own.of(place),
                residual=None,
                weights=one.weights,
                walls=one.problem.walls,
                noise=one.noise,
                noise_shift=shift,
            )
            for one, optimum, place, shift in zip(
                cameras, optima, together.places()[:-2], shifts, strict=True
            )
        ]
        return JointFit(
            fits=tuple(fits),
            problems=tuple(one.problem for one in cameras),
            together=together,
            covariance=shared_too,
            shared=shared,
            arm=arm,
            chosen=chosen,
            undetermined=undetermined,
        )


def _found(camera: _Camera) -> Parameters:
    """Return what was found of a camera so far."""
    return camera.core.solution.parameters


def _alone(problem: Problem, arm: Arm | None, joints: Sequence[int]) -> _Camera:
    """Fit one camera without the others."""
    recorded = problem.dataset
    with solvable(problem.dataset.first.path, "fit"):
        moments, weights = prepare(problem)
        problem, core = on_walls(problem, moments)
        refuse_diverged(core.solution.parameters)
    data, frames = problem.dataset, problem.frames
    walls = problem.estimated or lone_walls(data, frames)
    posed = None if arm is None else posed_arm(arm, joints, data, frames)
    view = View(core.moments, walls, posed)
    noise = known_noise(problem, weights)
    return _Camera(
        recorded=recorded, problem=problem, core=core, weights=weights, noise=noise, view=view
    )


def posed_arm(arm: Arm, chosen: Sequence[int], data: Dataset, frames: Frames) -> PosedArm:
    """Return an arm at frames of a data set.

    Raises:
        CalibrationDataError: The recordings lack joint angles, or have those of other joints.
        ConfigError: The arm takes the tool elsewhere.
    """
    for recording in data.recordings:
        if recording.frames.joint_angles is None:
            said = f"{recording.path / TABLE_FILE}: columns 'joint_1', 'joint_2', ... are missing"
            raise CalibrationDataError(f"{said}; a fit of the robot's joints needs them.")
        names = [name for name, long in zip(arm.names, arm.is_length, strict=True) if not long]
        if (number := recording.frames.joint_angles.shape[1]) != len(names):
            said = f"{recording.path / TABLE_FILE}: there are {number} joint angles, the URDF has"
            raise CalibrationDataError(f"{said} {len(names)}: {', '.join(names)}.")
    at, path = torch.as_tensor(np.asarray(frames)), data.first.path
    angles, pose = arm.placed(data.column("joint_angles")[at]), data.column("world_from_tool")[at]
    backwards = data.first.frame_names.eye_to_hand
    tool = se3.inverse(arm.poses(angles)) @ (se3.inverse(pose) if backwards else pose)
    off = float((tool - tool[:1]).abs().amax())
    if off > _SAME_TOOL:
        said = f"poses and joint angles disagree by up to {off:.2g} m or rad"
        names = "`frames: {world: BASE, tool: TIP}` in recording.yaml names the URDF's links"
        raise ConfigError(
            f"{path}: {said}. Are angles in radians, and is `world` the base? {names}."
        )
    return PosedArm(arm, tuple(chosen), angles, tool, backwards)


def shared_poses(problems: Sequence[Problem]) -> list[Tensor]:
    """Return the pose of each frame of each camera, (N,), numbered over all of them without gaps.

    Cameras whose frames have the same `world_from_tool` share its error.
    """
    places, found = np.zeros((0, 16)), list[np.ndarray]()
    for problem in problems:
        groups = problem.dataset.pose_groups()[problem.frames]
        _, first, number = np.unique(groups, return_index=True, return_inverse=True)
        pose = problem.dataset.column("world_from_tool")[problem.frames][first]
        own, of_pose = pose.flatten(1).numpy(), len(places) + np.arange(len(first))
        if len(places):
            apart = np.abs(own[:, None] - places).max(axis=2)
            near = apart.min(axis=1) <= STANDSTILL
            of_pose[near] = apart.argmin(axis=1)[near]
        places = np.concatenate([places, own])
        found.append(of_pose[number])
    numbered = np.unique(np.concatenate(found), return_inverse=True)[1]
    return list(torch.from_numpy(numbered).split([len(one) for one in found]))


def _shared_walls(
    problems: Sequence[Problem],
) -> tuple[Planes | None, tuple[Tensor, ...] | None]:
    """Return the walls of all cameras, and which of them each camera's are; None: they are known.

    Two cameras see the same wall if their planes, each found by one camera alone, are as near as
    the wide prior on a wall, and if the target is the same. Names of walls that an importer found
    say nothing.
    """
    planes, targets, shared = list[Tensor](), list[str](), list[Tensor]()
    for problem in problems:
        if problem.walls is None:
            return None, None
        data, found, own = problem.dataset, problem.walls, list[int]()
        each = zip(found.numbers, found.walls.normal_world, found.walls.offset, strict=True)
        for number, normal, offset in each:
            plane = torch.cat([normal, offset[None]])
            target = "" if data.planes_are_estimated else data.targets[found.of_frame == number][0]
            far = [
                float((plane - other).abs().max()) if k not in own and name == target else 1.0
                for k, (other, name) in enumerate(zip(planes, targets, strict=True))
            ]
            if far and min(far) < PRIOR_SIGMA:
                own.append(far.index(min(far)))
            else:
                own.append(len(planes))
                planes.append(plane)
                targets.append(target)
        shared.append(torch.tensor(own))
    both = torch.stack(planes)
    return Planes(both[:, :3], both[:, 3]), tuple(shared)


def _undetermined(
    cameras: Sequence[_Camera], together: Together, variance: float, arm: Arm | None
) -> dict[int, str]:
    """Return the joints whose offsets nothing determines, and what they cannot be told from."""
    places = together.places()
    joints, found = places[-1], dict[int, str]()
    if arm is None:
        return found
    prior, _ = _prior(cameras, together, variance, smoothness=True)
    images = together.all_equations([one.view for one in cameras]).total().plus(prior)
    wide = torch.full((together.size,), PRIOR_SIGMA, dtype=torch.float64)
    wide[joints] = torch.inf  # Their prior is in the equations already.
    precision = images.hessian / variance + wide.pow(-2).diag()
    free = torch.ones(together.size, dtype=torch.bool)

    def share(known: Tensor) -> Tensor:
        """Return each offset's variance as a share of its prior's, with some unknowns known."""
        kept = (free & ~known).nonzero()[:, 0]
        every = torch.zeros(together.size, dtype=torch.float64)
        every[kept] = torch.linalg.inv(precision[kept][:, kept]).diagonal()
        return every[joints] / together.sigmas**2

    nothing = torch.zeros_like(free)
    # Half of the variance is then the prior's.
    while (here := share(nothing)).max() > 1 / 2:
        worst = int(here.argmax())
        turn, axis = ("turn", "about its axis") if arm.turns[worst] else ("shift", "along it")
        groups = {f"a {turn} of the camera {axis}": torch.cat([p[:6] for p in places[:-2]])}
        groups |= {f"a {turn} of all walls {axis}": places[-2]}
        groups |= {"those of others together": joints}
        found[worst] = ""
        for words, group in groups.items():
            known = nothing.clone()
            known[group] = True
            known[joints[worst]] = False
            if share(known)[worst] < 1 / 2:
                found[worst] = words
                break
        free[joints[worst]] = False
    return found


def _prior(
    cameras: Sequence[_Camera], together: Together, variance: float, *, smoothness: bool = False
) -> tuple[NormalEquations, list[Tensor]]:
    """Return the priors' normal equations in all unknowns, and the scores of their rows.

    Args:
        cameras: The cameras; without any, of the joints alone.
        together: Where.
        variance: The effective variance of a residual of the first camera.
        smoothness: Whether the priors on undetermined directions are left out.
    """
    size, places = together.size, together.places()
    joints, gradient = places[-1], together.total.new_zeros(size)
    hessian, of_joints = gradient.new_zeros(size, size), gradient.new_zeros(size, len(joints))
    of_joints[joints] = (variance / together.sigmas).diag()
    known = variance / together.sigmas**2
    scores, loss = [of_joints], (known * together.offsets**2).sum()
    gradient[joints] = known * together.offsets
    hessian[joints, joints] = known
    for camera, own, there in zip(cameras, together.cameras, places[:-2], strict=False):
        prior = camera.core.smoothness if smoothness else camera.core.total_prior
        if prior is None:
            continue
        weight, found = camera.view.weight, prior.equations(own)
        loss = loss + weight * found.loss
        gradient[there] += weight * found.gradient
        hessian[there[:, None], there] += weight * found.hessian
        rows = gradient.new_zeros(size, prior.factor.shape[0])
        rows[there] = weight * prior.scores
        scores.append(rows)
    return NormalEquations(loss, gradient, hessian), scores


def _held(
    cameras: Sequence[_Camera],
    together: Together,
    variance: float,
    shared: tuple[Tensor, ...] | None,
) -> tuple[list[_Camera], Together]:
    """Solve each camera's own unknowns once more, and hold what nothing determines."""
    cameras = _placed(cameras, together, shared)
    images = together.all_equations([one.view for one in cameras]).total()
    hessian, done = images.plus(_prior((), together, variance)[0]).hessian, list[_Camera]()
    for camera, place in zip(cameras, together.places()[:-2], strict=True):
        objective = MomentObjective(camera.core.moments, camera.core.smoothness)
        solution = minimise(objective, _found(camera), camera.problem.options.solver)
        core = replace(camera.core, solution=solution, start=_found(camera), prior=None)
        core = hold(camera.problem, core, marginal(hessian, place) / camera.view.weight)
        done.append(replace(camera, core=core))
    return done, together.with_cameras([_found(one) for one in done])


def _placed(
    cameras: Sequence[_Camera], together: Together, shared: tuple[Tensor, ...] | None
) -> list[_Camera]:
    """Return the cameras at the unknowns: on the walls, at the poses, with parameters as found."""
    done = list[_Camera]()
    for k, (camera, own) in enumerate(zip(cameras, together.cameras, strict=True)):
        data, walls, view = camera.recorded, camera.problem.walls, camera.view
        if view.arm is not None:
            every = posed_arm(view.arm.arm, view.arm.chosen, data, np.arange(data.num_frames))
            data = data.with_columns(world_from_tool=every.poses(together.offsets).numpy())
        if walls is not None and together.planes is not None and shared is not None:
            planes = {name: one[shared[k]] for name, one in vars(together.planes).items()}
            pose = together.walls_of(view).world_from_tool
            walls = replace(walls, walls=replace(walls.walls, world_from_tool=pose, **planes))
            data = walls.put_into(data)
        solution = replace(camera.core.solution, parameters=own.detached())
        moments = together.walls_of(view).seen_by(camera.core.moments)
        core = replace(camera.core, solution=solution, moments=moments)
        problem = replace(camera.problem, dataset=data, walls=walls)
        done.append(replace(camera, problem=problem, core=core))
    return done


def _off_noise(
    cameras: Sequence[_Camera],
    together: Together,
    prior: NormalEquations,
    shared: tuple[Tensor, ...] | None,
) -> tuple[list[_Camera], Together, list[Shift | None]]:
    """Move all unknowns back by what the noise of the distances has moved them.

    Returns:
        The cameras; all unknowns; and how far the noise moved each camera, None where it is
        unknown or the hand-eye transform is not estimated.
    """
    hessian, noise = prior.hessian, NormalEquations(*(0 * part for part in prior))
    for number, one in enumerate(cameras):
        images = together.equations(one.view, number).total()
        hessian = hessian + images.hessian
        if one.noise is not None:
            expected = expected_moments(one.problem, one.core, one.weights, one.noise)
            own = together.equations(replace(one.view, moments=expected), number).total()
            noise = noise.plus(within_loss(images, own))
    step = step_off_noise(hessian, noise)
    removed = all(
        one.problem.options.remove_noise_shift and one.core.solution.converged for one in cameras
    )
    shifts = [
        None
        if one.noise is None or not own.hand_eye_is_free
        else Shift("noise", "the noise of the distances", -step[place[:6]], removed=removed)
        for one, own, place in zip(cameras, together.cameras, together.places(), strict=False)
    ]
    if not removed or not any(one.noise for one in cameras):
        return list(cameras), together, shifts
    together = together.moved(step)
    return _placed(cameras, together, shared), together, shifts
