"""The experiment of `evaluate` and `select`: models measured on frames not fitted to.

No held-out image takes part in a fit: moments are those of the training frames; noise, robust
weights, estimated walls and a model's own outlier window are found in the training frames alone;
the other masks look at one image at a time. Only two things are found once in all frames: the
ranges that scale a term's variable and place a curve's knots, and the masks common to all models,
which say which pixels the comparison is about.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import product
from time import perf_counter

import numpy as np

from tofcorr.comparison.options import BEFORE, ComparedModel, ComparisonOptions, masks_of
from tofcorr.comparison.statistics import Estimate
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.joint import estimate_walls
from tofcorr.estimation.moments import ImageMoments
from tofcorr.fit.fitting import fit, hand_eye_alone
from tofcorr.fit.problem import FitOptions, Problem, build_model, refuse_missing_inputs
from tofcorr.fit.walls import FoundWalls, recorded_walls, walls_alone, with_every_wall
from tofcorr.pixels.dataset import Dataset, hand_eye_is_free, recorded_hand_eye
from tofcorr.pixels.lattice import Lattice, covered_domain, lattice_of
from tofcorr.pixels.passes import FittedModel, FrameErrors, held_out_errors, image_moments, views_mm
from tofcorr.pixels.sample import MaskOptions, usable_pixels
from tofcorr.plausibility.finding import Inspection
from tofcorr.progress import LOG, through
from tofcorr.training.calibration import TrainingOptions, without_correction
from tofcorr.training.judgement import frames_left_out, left_out_mapping, left_out_words


def without_frames(
    splits: Mapping[str, np.ndarray], frames: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the splits without some frames, and without those that then hold nothing out.

    Frames that disagree with all others are taken out of splits that were drawn with them, as a
    training does: so the half split is that of a training.
    """
    kept = {name: np.setdiff1d(test, frames) for name, test in splits.items()}
    return {name: test for name, test in kept.items() if len(test) or not len(splits[name])}


# Parts of the RMS error in z: offset and tilts of whole images, which no model of a pixel sees; the
# rest; and all of it with each held-out plane estimated again within its covariance, if it has one.
VIEWS = "between_views", "within_views", "within_prior"
METRICS: dict[str, Callable[[dict[str, FrameErrors]], float]] = {
    "mean_abs_mm": lambda errors: errors["to_plane"].mean_abs_mm(),
    "rms_mm": lambda errors: errors["to_plane"].rms_mm(),
    "rms_along_ray_mm": lambda errors: errors["along_ray"].rms_mm(),
    "rms_z_mm": lambda errors: errors["in_z"].rms_mm(),
    **{f"{of}_mm": lambda errors, of=of: views_mm(errors)[of] for of in VIEWS},
}


class Experiment:
    """Models on one set of images, each measured on frames that it was not fitted to.

    A column exists once `measure` has ended for it; `compare` does that for all.

    Every model is measured on the same pixels: those of the recordings' masks that the options'
    own masks leave.

    Args:
        name: The set's name.
        dataset: The recordings.
        options: The models, and what is held out.
        inspection: What was odd about the recordings. Frames that disagree with all others are
            left out, as a training leaves them out, and garbage is met as there; None: neither.

    Raises:
        CalibrationDataError: A model needs what a recording lacks, no pixel is usable, or there are
            too few poses for the splits.

    Attributes:
        name: The set's name.
        dataset: Its recordings.
        options: The models, as the recordings made them.
        splits: What was held out.
        skipped: What could not be, and why.
        hand_eye: tool_from_camera of each column, fitted to the first split's training frames.
        errors: Errors on the frames held out: by protocol, split, column and kind.
        fitter: What fitted them, and the pixels that measure them.
        left_out: Frames that are neither fitted nor measured, and how far off they are, as in the
            report of a training.
        warnings: What limits the numbers, one sentence each.
    """

    def __init__(
        self,
        name: str,
        dataset: Dataset,
        options: ComparisonOptions,
        inspection: Inspection | None = None,
    ) -> None:
        self.name, self.dataset = name, dataset
        self.options = options.for_recordings(dataset.recordings).against_garbage(inspection)
        # The masks alone say which pixels the splits look at.
        usable = usable_pixels(dataset, self.options, robust=False)
        splits, self.skipped = self.options.splits(usable)
        frames, left_out, self.left_out = np.arange(dataset.num_frames), (), []
        if inspection is not None:
            drawn = [np.setdiff1d(frames, test) for own in splits.values() for test in own.values()]
            left_out = frames_left_out(inspection, drawn)
            self.left_out = left_out_mapping(left_out, inspection)
            splits = {kind: without_frames(own, left_out) for kind, own in splits.items()}
        self.splits = splits
        self.fitter = ModelFitter(dataset, self.options, left_out)
        self.warnings = self.fitter.warnings  # The same list: fits to come add theirs.
        self.warnings += left_out_words(left_out)
        self.hand_eye = dict[str, list[list[float]]]()
        by_column = dict[str, dict[str, FrameErrors]]
        self.errors = {kind: [by_column() for _ in own] for kind, own in splits.items()}

    def measure(self, column: str) -> float:
        """Fit one column to each split's frames; return the RMS of the first protocol, mm."""
        fitter, model = self.fitter, {one.name: one for one in self.options.models}.get(column)
        fitted = partial(fitter.bare, column) if model is None else partial(fitter.fit, model)
        tests = [test for splits in self.splits.values() for test in splits.values()]
        tests = through(tests, f"{self.name} {column}".strip(), "split")
        found = [fitted(np.setdiff1d(fitter.frames, test), test) for test in tests]
        self.hand_eye[column] = found[0].model.hand_eye().detach().tolist()
        errors = iter(held_out_errors(fitter.measured, found, self.options.device))
        for place in (one for splits in self.errors.values() for one in splits):
            place[column] = next(errors)
        return self.held_out(next(iter(self.errors)), column).rms_mm()

    @property
    def hand_eye_estimated(self) -> bool:
        """Whether the hand-eye transform was an unknown."""
        return hand_eye_is_free(self.dataset, self.options.hand_eye)

    @property
    def targets(self) -> dict[str, int]:
        """How many images show which target."""
        names, counts = np.unique(self.dataset.targets, return_counts=True)
        return dict(zip(names.tolist(), counts.tolist(), strict=True))

    def held_out(self, protocol: str, column: str) -> FrameErrors:
        """Return a column's distances to the plane on held-out frames, of all splits in turn."""
        parts = [vars(one[column]["to_plane"]) for one in self.errors[protocol]]
        return FrameErrors(**{key: np.concatenate([one[key] for one in parts]) for key in parts[0]})

    def by_wall(self, protocol: str) -> dict[str, dict[str, float]]:
        """Return the RMS of each wall's held-out pixels by the wall's name and by column, mm."""
        walls = {name: np.flatnonzero(self.dataset.targets == name) for name in self.targets}
        errors = {column: self.held_out(protocol, column) for column in self.options.columns}
        return {k: {c: one.rms_mm(own) for c, one in errors.items()} for k, own in walls.items()}

    @cached_property
    def values(self) -> dict[str, dict[str, dict[str, np.ndarray]]]:
        """For each protocol, metric and column, one value a split, shape (S,), millimetres."""
        found = {protocol: dict[str, dict[str, np.ndarray]]() for protocol in self.errors}
        for (protocol, splits), (metric, of) in product(self.errors.items(), METRICS.items()):
            each = {column: [of(one[column]) for one in splits] for column in self.options.columns}
            found[protocol][metric] = {column: np.array(own) for column, own in each.items()}
        return found

    def estimate(
        self, protocol: str, metric: str, column: str, less: str | None = None
    ) -> Estimate:
        """Return the mean over the splits of a protocol, with its interval, millimetres.

        Args:
            protocol: How images were held out.
            metric: What is averaged.
            column: The model.
            less: Another one, whose values are subtracted: a paired t-test.
        """
        values = self.values[protocol][metric]
        difference = values[column] - (0.0 if less is None else values[less])
        return Estimate(difference, self.options.overlap(protocol))


def compare(sets: Sequence[Experiment], tell: Callable[[str], object] = LOG.info) -> list[str]:
    """Measure every column on every set, one column after the other.

    Ctrl-C, once a model is finished, ends it: what is not finished is left out, with a warning.

    Args:
        sets: With the same columns.
        tell: Called with a sentence about the work ahead, and with one as each column ends.

    Returns:
        The columns that were measured.
    """
    options, done = sets[0].options, list[str]()
    fits = sum(len(splits) for one in sets for splits in one.splits.values())
    tell(f"{len(options.models)} models, {fits} fits each; how long follows with the first.")
    sizes = {one.name: sets[0].fitter.size(one) for one in options.models}
    try:
        for column in through(options.columns, "models", "model"):
            start = perf_counter()
            errors = ", ".join(f"{one.measure(column):.2f}" for one in sets)
            done.append(column)
            spent = perf_counter() - start
            tell(f"{column}: {errors} mm RMS held out, after {spent:.0f} s")
            if column == options.models[0].name and len(sizes) > 1:
                ahead = spent * (sum(sizes.values()) / sizes[column] - 1)
                long = f"{ahead:.0f} s" if ahead < 100 else f"{ahead / 60:.0f} min"
                tell(f"The other models will take about {long}.")
    except KeyboardInterrupt:
        if not set(done) - set(options.baselines):
            raise
        for one in sets:
            one.options = one.options.only(done)
            one.hand_eye = {column: one.hand_eye[column] for column in done}
        missing = ", ".join(column for column in options.columns if column not in done)
        sets[0].warnings.append(f"Stopped: {missing} not finished, and left out.")
    return done


class ModelFitter:
    """Fits the models of a comparison to some of a data set's frames, as a training would.

    Args:
        dataset: The recordings.
        options: Models, masks, hand-eye, solver and device.
        left_out: Global numbers of frames that no fit uses and no error measures.

    Attributes:
        frames: Global numbers of all others.
        measured: The data set with the pixels that measure every model: the common masks.
        domain: The ranges that scale the models' variables, of all measured pixels.
        num_pixels: How many of its pixels measure, of all frames together.
        warnings: A sentence for each fit that did not converge, or lacks a held-out wall.

    Raises:
        CalibrationDataError: A model needs what a recording lacks, or no pixel is usable.
    """

    def __init__(
        self, dataset: Dataset, options: ComparisonOptions, left_out: Collection[int] = ()
    ) -> None:
        self._dataset, self._options = dataset, options
        self.frames = used = np.setdiff1d(np.arange(dataset.num_frames), list(left_out))
        self._trainings = {model.name: options.training(model) for model in options.models}
        self.measured = usable_pixels(dataset, options, robust=False)
        self.domain = covered_domain(self.measured, used)
        self.warnings: list[str] = []
        self._of_all_frames: dict[str, tuple[ImageMoments, Lattice]] = {}
        for training in self._trainings.values():
            refuse_missing_inputs(dataset, training.model)
        self._geometry = self._moments(self.measured, ErrorModelOptions())
        self.num_pixels = int(self._geometry.images(used.tolist()).count.sum())

    def fit(self, model: ComparedModel, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Fit one model to training frames, to be measured on held-out ones (global numbers)."""
        training = self._trainings[model.name]
        dataset, moments, lattice = self._usable(training, train), None, None
        own_window = masks_of(training) != masks_of(self._options) and training.outlier_window_mm
        if not (training.weights.noise or training.weights.robust != "none" or own_window):
            # The pixels are those of any other split: they are read once.
            if model.name not in self._of_all_frames:
                # Those of one model at a time: they take most of the memory.
                both = self._moments(dataset, training.model), lattice_of(dataset)
                self._of_all_frames = {model.name: both}
            moments, lattice = self._of_all_frames[model.name]
            moments, lattice = moments.images(train.tolist()), lattice.frames(train)
        found = fit(dataset, train, training, self.domain, moments=moments, lattice=lattice)
        if not found.solution.converged:
            fitted = f"{model.name}, fitted to {len(train)} frames"
            self.warnings.append(f"{fitted}: {found.solution.message}")
        planes = self._judged_against(found.walls, model.name, held_out, found.model)
        return FittedModel(found.model, held_out, planes, found.observability.variance)

    def size(self, model: ComparedModel) -> float:
        """Return about how long a model takes to fit, in times one without terms.

        Sums and solutions grow with the square of the coefficients. Fitted to the times of the
        shipped `all_models` on the simulated `demo`, where 15 double them, and a network of 10 000
        pixels, trained once for each fold as well, takes 150 times as long.
        """
        training = self._trainings[model.name]
        unknowns = len(ErrorModel(training.model, self.domain).coefficient_vector())
        return 1 + (unknowns / 15) ** 2 + 150 * (training.residual is not None)

    def bare(self, name: str, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Return a hand-eye transform without depth correction.

        `BEFORE`: the recorded one; planes that were estimated in the depth are estimated again, in
        the training images. Else it is fitted alone: to the common pixels, all of the same weight.
        """
        found = None
        if name == BEFORE:
            model = without_correction(self.domain, recorded_hand_eye(self._dataset))
            if self._dataset.planes_are_estimated:
                found = walls_alone(self.measured, train, model)
        else:
            moments = self._geometry.images(train.tolist()).columns([])
            given, nothing = self._options, ErrorModelOptions()
            options = FitOptions(model=nothing, hand_eye=given.hand_eye, solver=given.solver)
            problem = Problem(self.measured, train, options, self.domain)
            best = hand_eye_alone(problem, moments)
            if self._options.planes == "unknown":
                found = recorded_walls(self._dataset, train)
                best, walls = estimate_walls(moments, best, found.walls)
                found = replace(found, walls=walls)
            model = without_correction(self.domain, best.tool_from_camera)
        return FittedModel(model, held_out, self._judged_against(found, name, held_out, model))

    def _usable(self, training: TrainingOptions, train: np.ndarray) -> Dataset:
        """Return the data set with the pixels that a model is fitted to."""
        robust = training.weights.robust != "none"
        if masks_of(training) == masks_of(self._options):
            # The window of the common masks is already there, and must not be centred again.
            return usable_pixels(self.measured, MaskOptions(), robust=robust)
        return usable_pixels(self._dataset, training, robust=robust, frames=train)

    def _moments(self, dataset: Dataset, model: ErrorModelOptions) -> ImageMoments:
        """Return a model's moments of all frames."""
        _, design = build_model(dataset, model, self.domain)
        return image_moments(dataset, design, device=self._options.device)

    def _judged_against(
        self, found: FoundWalls | None, name: str, held_out: np.ndarray, model: CalibrationModel
    ) -> Dataset | None:
        """Return the data set with the planes for the held-out frames; None: those recorded."""
        if found is None or self._options.planes == "known":
            return None
        if self._dataset.planes_are_estimated:
            return with_every_wall(self.measured, found, model)
        unseen = set(found.of_frame[held_out].tolist()) - set(found.numbers.tolist())
        for wall in sorted(unseen):
            said = f"{name}: no training image shows the wall '{found.names[wall]}'"
            self.warnings.append(f"{said}; its images are judged against the recorded plane.")
        return found.put_into(self._dataset)
