r"""Fits one model to some frames of a data set: moments, least loss, walls, and what else moves it.

`fit` reads the pixels into moments (`prepare`), minimises the loss (`solve`), holds directions that
the images do not determine, solves again where the walls are unknown, and adds what does not go
through moments (`finish`): covariance, fixed pattern, residual network, and the noise's shift.

*The noise's shift.* The error terms are functions of the measured distance D, which has noise of
variance s^2. A pixel's squared residual therefore contains, beyond the noise of its plane distance,

.. math:: s^2 \Big(\cos\theta\,\big(1 - \textstyle\sum_k \beta_k f_k'(D)\big)\Big)^2 ,

which is smaller where the correction shrinks all distances. The fit does so a little, and the
hand-eye transform makes up for it, above all along the viewing direction. No scatter between poses
shows that: it is the same in all of them. The expected term is a quadratic form like the moments,
with the columns' derivatives in place of the columns (the corrected score of Nakamura 1990), so one
Newton step without it says how far the least loss has moved.

Hand-eye transform, coefficients and estimated walls are moved back together: one makes up for the
other, and only together do they put corrected points on the planes.
"""

from contextlib import suppress
from dataclasses import replace
from itertools import repeat

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain, Term
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.joint import Together, View, estimate_together, estimate_walls
from tofcorr.estimation.linear import Curvature, NormalEquations, solvable
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import Planes, joint_image_equations, within_prior
from tofcorr.estimation.regularisation import (
    penalties_of,
    smoothness,
    time_constant,
    total_weight,
    with_strengths,
)
from tofcorr.estimation.solvers import Solution, SolverOptions, Watcher, minimise
from tofcorr.estimation.uncertainty import (
    PRIOR_SIGMA,
    Covariance,
    effective_variance,
    jackknife_covariance,
    observability,
    prior_on_undetermined,
)
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.problem import Core, Fit, FitOptions, Problem, Shift, build_model
from tofcorr.fit.residual import fit_residual
from tofcorr.fit.walls import lone_walls, recorded_walls
from tofcorr.fit.weighting import PixelWeights, first_weights
from tofcorr.geometry.rays import plane_precision
from tofcorr.pixels.dataset import Dataset, Frames, thread_number
from tofcorr.pixels.lattice import Lattice, estimate_noise, lattice_of, spread_pixels
from tofcorr.pixels.passes import image_moments
from tofcorr.pixels.sample import distance_to_plane


def fit(
    dataset: Dataset,
    frames: Frames,
    options: FitOptions,
    domain: Domain | PriorKnowledge,
    watcher: Watcher | None = None,
    resumed: Parameters | None = None,
    moments: ImageMoments | None = None,
    lattice: Lattice | None = None,
) -> Fit:
    """Fit one model to frames, from one pass over their pixels.

    Where walls are unknown, they are estimated from the moments of that same pass. Robust weights
    need a pass more for each time they are computed. A penalty whose strength is left open gets the
    strength that predicts held-out poses best, a warm-up the time constant that reduces the loss
    most. The residual network comes last and needs one more pass, in which a few thousand pixels
    are drawn.

    A direction that the images do not determine is held near the start by a weak prior, or
    refused, as the options say.

    Where the noise of the measured distances is known, what it moves is taken off the estimate.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames to fit.
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables, or what earlier calibrations say for
            such ranges.
        watcher: Called after each iteration of the solver.
        resumed: Where an interrupted fit stood; None starts anew.
        moments: Those of the frames with exactly the model's image columns, if they are known
            from an earlier pass, where all pixels weigh the same.
        lattice: That of the frames, if it is known.

    Raises:
        CalibrationDataError: The recordings lack an input of the model, the images do not
            determine a direction and the options refuse that, or they determine nothing.
    """
    with solvable(dataset.first.path, "fit"), thread_number(1):
        frames = np.asarray(frames)
        seen = lattice_of(dataset, frames) if lattice is None else lattice
        known = domain if isinstance(domain, PriorKnowledge) else None
        ranges = domain if isinstance(domain, Domain) else domain.domain
        problem = Problem(dataset, frames, options, ranges, seen, watcher, resumed, known=known)
        weights = None
        if moments is None:
            moments, weights = prepare(problem)
        problem, core, covariance = estimate(problem, moments)
        optimum = core.solution.parameters
        hand_eye_only = hand_eye_alone(problem, core.moments)
        noise = known_noise(problem, weights)
        outcome, with_network, best = None, None, optimum
        if options.residual is not None:
            error = with_pattern(problem, core).error
            outcome, error.residual, best = fit_residual(problem, core, error, options.residual)
            with_network = None if error.residual is None else error
        kept = with_network is not None
        problem, core, shift = _without_noise_shift(problem, core, weights, noise, kept)
        if with_network is None:
            model = with_pattern(problem, core)
        else:
            core = replace(core, solution=replace(core.solution, parameters=best))
            model = calibrated(with_network, best)
        return Fit(
            **vars(core),
            model=model,
            domain=problem.domain,
            optimum=best,
            hand_eye_only=hand_eye_only,
            covariance=covariance,
            residual=outcome,
            weights=weights,
            walls=problem.walls,
            noise=noise,
            noise_shift=shift,
        )


def estimate(problem: Problem, moments: ImageMoments) -> tuple[Problem, Core, Covariance]:
    """Find the least loss of moments, on walls that are estimated where they are unknown.

    Returns:
        The problem, on those walls; the solution; and its covariance, by leaving out poses.

    Raises:
        CalibrationDataError: The frames do not determine the model, or are of fewer than 3 poses.
    """
    problem, core = on_walls(problem, moments)
    refuse_diverged(core.solution.parameters)
    optimum, prior, poses = core.solution.parameters, core.total_prior, problem.poses()
    # At the least loss, where the gradients of the poses sum to zero.
    covariance = jackknife_covariance(core.moments, optimum, prior, poses, problem.estimated)
    return problem, core, covariance


def fit_of_moments(problem: Problem, moments: ImageMoments) -> Fit:
    """Return the fit of moments alone, quickly: all unknowns and walls at once.

    What the images do not determine stays near the start, and the noise's shift is left in.

    Args:
        problem: What to fit, without penalties; it starts where it is resumed.
        moments: Of its frames, with exactly the model's image columns.

    Raises:
        CalibrationDataError: The frames do not determine the model, or are of fewer than 3 poses.
    """
    dataset, frames = problem.dataset, problem.frames
    options = with_time_constants(problem, moments)
    model = ErrorModel(options, problem.domain)
    moments = with_condition_terms(model, moments, dataset.conditions(frames))
    start = problem.start(moments)
    found = recorded_walls(dataset, frames) if problem.estimates_walls else None
    view = View(moments, found.walls if found else lone_walls(dataset, frames))
    planes = found and Planes(found.walls.normal_world, found.walls.offset)
    together = Together.start([start], planes, *start.coefficients.new_zeros(2, 0))
    # Chosen: what is left shows in no digit, and from the last fit it takes one or two steps.
    quick = SolverOptions(max_iterations=25, tolerance=1 / 1000)
    end = estimate_together([view], together, solver=quick)
    best, walls = end.cameras[0], end.walls_of(view)
    refuse_diverged(best)
    seen, estimated = walls.seen_by(moments), None if found is None else walls
    observed = observability(seen, best, None, estimated)
    prior = prior_on_undetermined(observed, problem.guess(seen))
    return Fit(
        options=options,
        moments=seen,
        start=start,
        solution=Solution(best),
        smoothness=None,
        observability=observed,
        prior=prior,
        model=calibrated(model, best),
        domain=problem.domain,
        optimum=best,
        hand_eye_only=best,
        covariance=jackknife_covariance(seen, best, prior, problem.poses(), estimated),
        walls=found and replace(found, walls=walls),
    )


def hand_eye_alone(problem: Problem, moments: ImageMoments) -> Parameters:
    """Fit the hand-eye transform alone to moments of the problem's frames.

    Raises:
        CalibrationDataError: The frames do not determine it.
    """
    geometry = moments.columns([])
    start = replace(problem, resumed=None).start(geometry)
    found = minimise(MomentObjective(geometry), start, problem.options.solver).parameters
    refuse_diverged(found)
    return found


def prepare(problem: Problem) -> tuple[ImageMoments, PixelWeights | None]:
    """Read the pixels once, or once for each pass of robust weights.

    Robust weights depend on the fit, and the fit on them. Both are computed in turn, with a pass
    over the pixels each time, until the fit no longer changes.

    Returns:
        The moments of the frames, and the weights of the pixels; None if all have the same.
    """
    frames, options, seen = problem.frames, problem.options, problem.dataset
    _, design = build_model(seen, options.model, problem.domain)
    walls = recorded_walls(seen, frames).walls if problem.estimates_walls else None
    asked = options.weights
    weights = first_weights(seen, frames, problem.lattice, asked.noise, asked.robust)
    moments = image_moments(seen, design, frames, weights, options.device)
    before = None
    for _ in range(0 if options.weights.robust == "none" else options.weights.passes):
        # Distances to a plane that is a mere guess would make every pixel an outlier.
        quiet = replace(problem, watcher=None)
        moments = moments if walls is None else walls.seen_by(moments)
        here, core = on_walls(quiet, moments, held=False)
        best, seen = core.solution.parameters, here.dataset
        now = torch.cat([best.tool_from_camera.flatten(), best.coefficients])
        # In metres, or without unit the entries of the rotation: far below any standard error.
        if before is not None and float((now - before).abs().max()) < options.solver.tolerance:
            break
        before, model = now, calibrated(ErrorModel(core.options, problem.domain), best)
        assert weights is not None
        weights = weights.updated(seen, frames, model)
        moments = image_moments(seen, design, frames, weights, options.device)
    return moments if walls is None else walls.seen_by(moments), weights


def on_walls(problem: Problem, moments: ImageMoments, *, held: bool = True) -> tuple[Problem, Core]:
    """Solve on walls that are estimated, or within what is not known of each image's.

    What earlier calibrations say weighs against images as these scatter: no less than the images of
    those calibrations did.

    Args:
        problem: What to fit.
        moments: Of its frames, with exactly the model's image columns.
        held: As for `solve`.

    Returns:
        The problem, on the walls found; and its solution.
    """
    found, core = _on_walls(problem, moments, held=held)
    if problem.known is None:
        return found, core
    seen = effective_variance(core.moments, core.solution.parameters)
    if seen <= problem.known.variance:
        return found, core
    known = replace(problem.known, variance=seen)
    return _on_walls(replace(problem, known=known), moments, held=held)


def _on_walls(
    problem: Problem, moments: ImageMoments, *, held: bool = True
) -> tuple[Problem, Core]:
    """Solve; then on walls that are estimated, or within what is not known of each image's."""
    core, covariance = solve(problem, moments, held=held), problem.dataset.plane_covariance()
    if not problem.estimates_walls and covariance is not None:
        best, poses = core.solution.parameters, problem.poses()
        variance = effective_variance(core.moments, best)
        known = variance * plane_precision(moments.normal_tool, covariance[problem.frames])
        # Images of one pose share the error of its plane: together they are held by one prior.
        known = known / torch.bincount(poses)[poses][:, None, None]
        at = replace(best, coefficients=best.coefficients[: len(moments.symbols)])
        again = replace(problem, resumed=best)
        return problem, solve(again, within_prior(moments, at, known), held=held)
    if not problem.estimates_walls:
        return problem, core
    found, best = recorded_walls(problem.dataset, problem.frames), core.solution.parameters
    before = core.carried or core.smoothness
    prior = None if before is None else before.equations(best)
    found = replace(found, walls=estimate_walls(core.moments, best, found.walls, prior)[1])
    problem = problem.on(found, resumed=best)
    return problem, solve(problem, found.walls.seen_by(moments), held=held)


def solve(problem: Problem, moments: ImageMoments, *, held: bool = True) -> Core:
    """Find the hand-eye transform and the coefficients that minimise the loss of the moments.

    Args:
        problem: What to fit.
        moments: Of its frames, with exactly the model's image columns.
        held: Whether directions that the images do not determine are looked for, and held.

    Raises:
        CalibrationDataError: There is one, and the options ask to refuse it.
    """
    solver, conditions = problem.options.solver, problem.dataset.conditions(problem.frames)
    options = with_time_constants(problem, moments)
    model = ErrorModel(options, problem.domain)
    moments = with_condition_terms(model, moments, conditions)
    if problem.known is not None and problem.known.variance:
        # Few frames may determine little: what they cannot tell starts where it is known.
        carried = problem.known.prior(problem.start(moments.columns([])))
        start = carried.centre if problem.resumed is None else problem.resumed
        found = minimise(MomentObjective(moments, carried), start, solver, problem.watcher)
        core = Core(options=options, moments=moments, start=start, smoothness=None, solution=found)
        core = replace(core, carried=carried)
        return hold(problem, core) if held else core
    start, poses = _start(problem, moments, model), problem.poses()
    # Six folds choose the strength of a penalty; poses go to them in turn, with all their images.
    # Runs of poses would choose stiffer curves: 0.1 mm worse on held-out views of a Kinect v2.
    held_out = [poses % 6 == k for k in range(6)]
    penalties = with_strengths(penalties_of(model), moments, start, held_out)
    both = zip(model.penalised(), penalties, strict=True)
    chosen = [float(one.strength) for (term, _), one in both if term.options.is_open("strength")]
    core = Core(
        options=options.with_found("strength", chosen),
        moments=moments,
        start=start,
        smoothness=(prior := smoothness(penalties, total_weight(moments), start)),
        solution=minimise(MomentObjective(moments, prior), start, solver, problem.watcher),
    )
    return hold(problem, core) if held else core


def with_time_constants(problem: Problem, moments: ImageMoments) -> ErrorModelOptions:
    """Return the terms with the time constants that reduce the loss most where they are open."""
    options = problem.options.model
    if any(term.is_open("time_constants_s") for term in options.terms):
        start, seconds = problem.start(moments), problem.dataset.conditions(problem.frames)
        around = minimise(MomentObjective(moments), start, problem.options.solver).parameters
        found = time_constant(moments, around, seconds[:, CONDITIONS.index("timestamp")])
        options = options.with_found("time_constants_s", repeat((found,)))
    return options


def with_condition_terms(
    model: ErrorModel, moments: ImageMoments, conditions: Tensor
) -> ImageMoments:
    """Return moments with the columns of a model's condition terms, at conditions (N, C)."""
    terms: list[Term] = list(model.condition_terms)  # type: ignore[arg-type]
    if not terms:
        return moments
    functions = torch.cat([term.basis(conditions) for term in terms])  # type: ignore[operator]
    return moments.with_conditions(functions.T, [one for term in terms for one in term.symbols])


def _start(problem: Problem, moments: ImageMoments, model: ErrorModel) -> Parameters:
    """Start penalised curves at zero: without the penalty the images hardly determine them."""
    penalised = {symbol for term, _ in model.penalised() for symbol in term.symbols}
    others = [symbol for symbol in moments.symbols if symbol not in penalised]
    found = problem.start(moments.columns(others))
    coefficients = torch.zeros(len(moments.symbols), dtype=torch.float64)
    coefficients[[moments.symbols.index(symbol) for symbol in others]] = found.coefficients
    return replace(found, coefficients=coefficients)


def hold(problem: Problem, core: Core, hessian: Tensor | None = None) -> Core:
    """Look for undetermined directions, and put a prior on them or refuse them.

    Args:
        problem: What was fitted.
        core: At the least loss.
        hessian: See `observability`.
    """
    moments, best, smooth = core.moments, core.solution.parameters, core.smoothness
    if smooth is not None:
        smooth = smooth.rescaled(effective_variance(moments, best))
    found = observability(moments, best, core.carried or smooth, problem.estimated)
    prior = prior_on_undetermined(found, problem.guess(moments))
    core = replace(core, smoothness=smooth, observability=found, prior=prior)
    if prior is None:
        return core
    if problem.options.free_directions == "refuse":
        advice = "tilt views about two axes, at more distances, or set free_directions: prior"
        names = "; ".join(prior.names)
        raise CalibrationDataError(f"The images do not determine: {names}; {advice}.")
    objective = MomentObjective(moments, core.total_prior)
    return replace(core, solution=minimise(objective, core.start, problem.options.solver))


def refuse_diverged(parameters: Parameters) -> None:
    """Refuse a hand-eye transform that the solver moved so far that it is no rotation any more.

    Raises:
        CalibrationDataError: The frames do not determine it, and its estimate grew without bounds.
    """
    rotation = parameters.tool_from_camera[:3, :3].detach()
    off = rotation @ rotation.T - torch.eye(3).to(rotation)
    # Rounding makes 1e-15 for a step of any sensible size; only one of millions of turns makes half
    # of the digits wrong.
    if not bool((off.abs() < torch.finfo(rotation.dtype).eps ** 0.5).all()):
        advice = "Record poses near and far and tilted to all sides, or choose a smaller model."
        raise CalibrationDataError(f"The frames do not determine the hand-eye transform. {advice}")


def calibrated(error: ErrorModel, parameters: Parameters) -> CalibrationModel:
    """Join an error model, given the coefficients, and the hand-eye transform of parameters."""
    error.set_coefficient_vector(parameters.coefficients)
    fixed = not parameters.hand_eye_is_free
    return CalibrationModel(error, HandEye(parameters.tool_from_camera, fixed=fixed))


def known_noise(problem: Problem, weights: PixelWeights | None) -> DistanceNoise | None:
    """Return the noise that weighs the pixels, or else the recording's; None: it is unknown."""
    if weights is not None and weights.noise is not None:
        return weights.noise
    if problem.dataset.has_amplitude:
        with suppress(CalibrationDataError):  # The recording may not determine it.
            return estimate_noise(problem.dataset, problem.frames, problem.lattice)
    return None


def with_pattern(problem: Problem, core: Core) -> CalibrationModel:
    """Return the model of a core, with its fixed pattern (H, W), metres, if there is to be one.

    The standard deviation tau of the offsets is that of the options or, by empirical Bayes, the
    variance of their means beyond the means' own uncertainty.
    """
    dataset, device = problem.dataset, problem.options.device
    model = calibrated(ErrorModel(core.options, problem.domain), core.solution.parameters)
    pattern = model.error.fixed_pattern
    if pattern is None:
        return model
    rays = dataset.ray_directions()
    # Sums over the frames: c r, c^2, r^2 and the count.
    total = rays.new_zeros(4, *rays.shape[:2])
    for batch in dataset.batches(problem.frames, device):
        here = rays.to(device)
        found, cosine = distance_to_plane(model, batch, here)
        sums = torch.stack([cosine * found, cosine**2, found**2, torch.ones_like(found)])
        total += (sums * batch.valid.to(found)).sum(dim=1).cpu()
    product, square, residual, number = total
    seen = square > 0
    mean = torch.where(seen, product / square, 0.0)
    within = (residual - mean * product).clamp(min=0)
    variance = within.sum() / (number - 1).clamp(min=0).sum().clamp(min=1)
    own = torch.where(seen, variance / square, torch.inf)
    spread = pattern.options.spread_mm  # type: ignore[attr-defined]
    of_offsets = torch.as_tensor(0.0 if spread == "auto" else (spread / 1000) ** 2)
    if spread == "auto" and bool(seen.any()):
        of_offsets = (mean[seen].square().mean() - own[seen].mean()).clamp(min=0)
    # Without spread and without uncertainty, the offsets are the means: zero.
    pattern.offset.copy_((mean * of_offsets / (of_offsets + own)).nan_to_num())
    return model


def _without_noise_shift(
    problem: Problem,
    core: Core,
    weights: PixelWeights | None,
    noise: DistanceNoise | None,
    with_network: bool = False,
) -> tuple[Problem, Core, Shift | None]:
    """Move an estimate back by what the noise of the distances has moved it.

    It stays at the least loss, and the shift is only stated, where the options say so, where the
    solver did not get there, and with a residual network, which is trained to the least loss too.

    Returns:
        The problem, on walls moved likewise where they were estimated; the core; and the shift,
        None where it is unknown or nothing is estimated that it could move.
    """
    optimum, walls = core.solution.parameters, problem.estimated
    if noise is None or not optimum.size:
        return problem, core, None
    images = joint_image_equations(core.moments, optimum, walls).total()
    prior = None if core.total_prior is None else core.total_prior.equations(optimum)
    expected = expected_moments(problem, core, weights, noise)
    excess = joint_image_equations(expected, optimum, walls).total()
    step = step_off_noise(images.plus(prior).hessian, within_loss(images, excess))
    own, of_walls = step[: optimum.size], step[optimum.size :]
    removed = problem.options.remove_noise_shift and core.solution.converged and not with_network
    shift = None
    if optimum.hand_eye_is_free:
        shift = Shift("noise", "the noise of the distances", -own[:6], removed=removed)
    if not removed:
        return problem, core, shift
    moments = core.moments
    if problem.walls is not None:
        found = problem.walls.walls.moved(of_walls)
        problem = problem.on(replace(problem.walls, walls=found), problem.resumed)
        moments = found.seen_by(moments)
    solution = replace(core.solution, parameters=optimum.moved(own).detached())
    return problem, replace(core, moments=moments, solution=solution), shift


def within_loss(images: NormalEquations, noise: NormalEquations) -> NormalEquations:
    """Return the noise's equations, made smaller where the images have less loss.

    The noise is part of the loss: one that would make more was taken for too large. Of a camera
    that the fit took to the wall both are rounding, of either sign.
    """
    factor = (images.loss / noise.loss).nan_to_num().clamp(min=0, max=1)
    return NormalEquations(*(factor * part for part in noise))


def step_off_noise(hessian: Tensor, noise: NormalEquations) -> Tensor:
    """Return the step from the least loss to where it were without the noise.

    Args:
        hessian: The curvature of images and priors, with the noise.
        noise: What the noise adds to the equations.
    """
    # In these coordinates the curvature is 1 in every direction, of which the noise makes a share.
    basis = Curvature(hessian).basis
    share, turn = torch.linalg.eigh(basis.T @ noise.hessian @ basis)
    basis = basis @ turn
    # No step is longer than ten times the first-order one. Chosen: a share of 0.7 (20 mm of noise,
    # 12 poses) still gives the right step.
    return basis @ ((basis.T @ noise.gradient) / (1 - share).clamp(min=1 / 10))


def expected_moments(
    problem: Problem, core: Core, weights: PixelWeights | None, noise: DistanceNoise
) -> ImageMoments:
    """Return what the noise adds to the moments, estimated from some pixels of every frame.

    The shift of about 50 000 pixels is known far better than it needs to be.

    Args:
        problem: What was fitted.
        core: At the least loss.
        weights: Of the pixels.
        noise: Of a measured distance.
    """
    assert problem.lattice is not None  # Whoever knows the noise has it.
    some = spread_pixels(problem.dataset, problem.frames, problem.lattice, 50_000)
    # Without amplitude the variance is infinite; no camera errs by more than this prior.
    variance = noise.variance(some.pixels.amplitude).clamp(max=PRIOR_SIGMA**2)
    if weights is not None:
        variance = variance * weights.of_sample(some)
    slopes = _slopes(ErrorModel(core.options, problem.domain), some.pixels)
    own = (slopes[:, None, :] * some.ray.T).flatten(0, 1)
    gram = torch.zeros_like(core.moments.gram)
    count = some.frame.bincount(minlength=len(gram))
    parts = zip(own.split(count.tolist(), dim=1), variance.split(count.tolist()), strict=True)
    for number, (columns, spread) in enumerate(parts):
        share = core.moments.count[number] / count[number].clamp(min=1)
        gram[number, :-1, :-1] = share * (columns * spread) @ columns.T
    return replace(core.moments, gram=gram)


def _slopes(error: ErrorModel, pixels: Pixels) -> Tensor:
    """Return the derivatives of the distance and of the model's columns by the distance, (C, M).

    Differences over steps of 0.1 mm: torch's forward mode imports torch.compile, which takes longer
    than a fit.
    """
    distance, step = pixels.radial_distance, 1 / 10_000
    with torch.no_grad():
        near, far = (
            error.columns_at(pixels._replace(radial_distance=distance + shift))
            for shift in (-step, step)
        )
    return torch.cat([torch.ones_like(far[:1]), (far - near) / (2 * step)])
