"""The options of `evaluate` and `select`: models, and which held-out pixels measure them."""

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, NonNegativeInt, model_validator

from tofcorr.data.recording import Recording
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.solvers import SolverOptions
from tofcorr.options import Options, resolve_options
from tofcorr.pixels.dataset import (
    Dataset,
    HandEyeOptions,
    PlaneChoice,
    SplitOptions,
    folds,
    resolved_planes,
    split_frames,
)
from tofcorr.pixels.sample import MaskOptions
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.judgement import against_garbage, masks_against_garbage

DECIDED_BY_THE_COMPARISON = ("split", "advice", "device", "runtime")
"""Training options that a model cannot set: the comparison decides them for all models."""

BEFORE = "before"
"""The recorded hand-eye transform, and no depth correction."""

HAND_EYE_ONLY = "hand-eye only"
"""The hand-eye transform refitted, and no depth correction: what geometry alone explains."""

Grouping = Literal["image", "distance", "target"]

Splits = dict[str, dict[str, np.ndarray]]
"""The frames held out (global numbers), by protocol or by what their groups are groups of, and then
by name; all others are fitted. Images of one pose stay together."""


class ComparedModel(TrainingOptions):
    """One model of a comparison; its keys are those of a training configuration.

    A key that the model leaves out takes the value of the comparison's own key of that name, if
    there is one, and otherwise the default of a training. A key that the model sets replaces that
    value as a whole: `weights: {robust: huber}` has `noise: false`.

    In YAML, `config: ea_robust` starts from a training configuration, shipped or a file: its keys
    count as set by the model, and further keys of the entry replace them.

    Attributes:
        name: The heading of the model's column.
        model: The terms of its error; none: the constant alone.
    """

    name: str = Field(min_length=1)
    model: ErrorModelOptions = ErrorModelOptions()

    @model_validator(mode="before")
    @classmethod
    def _from_training_configuration(cls, values: Any) -> Any:  # noqa: ANN401 - YAML's values
        if not isinstance(values, Mapping):
            return values
        for key in DECIDED_BY_THE_COMPARISON:
            if key in values:
                raise ValueError(f"'{key}' cannot differ from model to model; set it beside them")
        if "config" not in values:
            return values
        if not isinstance(values["config"], str):
            raise ConfigError("'config' is the name or the file of a training configuration")
        training = resolve_options(TrainingOptions, values["config"])
        chosen = training.model_fields_set - set(DECIDED_BY_THE_COMPARISON)
        own = {key: value for key, value in values.items() if key != "config"}
        return {name: getattr(training, name) for name in chosen} | own


class ComparisonOptions(MaskOptions):
    """Models, what is common to them, and which held-out pixels measure them.

    The keys of the masks (`mask`, `outlier_window_mm`, ...) choose the pixels of the recording
    once, before any split, as its mask.npy does. Every model is measured on those pixels, whatever
    pixels it was fitted to. A model that sets a key of the masks is fitted to pixels of its own,
    found without the held-out images.

    Attributes:
        models: The models to compare.
        seed: Seed of every random choice of images.
        hand_eye: What is known of the hand-eye transform, where a model does not say.
        solver: The optimiser, where a model does not say.
        planes: What the held-out images are judged against. `known`: the recorded planes, for
            every model, also one that was fitted with `planes: unknown`. `unknown`: the recorded
            planes are only a start; a model that estimates walls is judged against the walls that
            it found in its training images. `auto`: `unknown` where `recording.yaml` says
            `planes: estimated`, else `known`. Also the value of a model that does not say.
        device: Where the passes over the pixels run: `cpu`, `cuda`, `cuda:1`, ...
    """

    baselines: ClassVar[tuple[str, ...]] = ()

    models: tuple[ComparedModel, ...] = Field(min_length=1)
    seed: NonNegativeInt = 0
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    planes: PlaneChoice = "auto"
    device: str = "cpu"

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        for name in self.columns:
            if self.columns.count(name) > 1:
                raise ValueError(f"two columns would be called '{name}'; give each its own name")
        return self

    @property
    def columns(self) -> list[str]:
        """The headings of the models in tables."""
        return [*self.baselines, *(model.name for model in self.models)]

    def only(self, columns: Collection[str]) -> Self:
        """Return the options with the models of some columns."""
        models = tuple(model for model in self.models if model.name in columns)
        return self.model_copy(update={"models": models})

    def splits(self, dataset: Dataset) -> tuple[Splits, dict[str, str]]:
        """Return what is held out, and why something that was asked for cannot be.

        Raises:
            CalibrationDataError: There are too few poses.
        """
        raise NotImplementedError

    def overlap(self, protocol: str) -> float:
        """Return how much the splits of a protocol have in common, see `statistics.estimate`."""
        return 0.0

    def training(self, model: ComparedModel) -> TrainingOptions:
        """Return the options that a model is fitted with: its own, completed by the common ones."""
        names = {"hand_eye", "solver", "planes", *MaskOptions.model_fields}
        common = {name: getattr(self, name) for name in names - model.model_fields_set}
        if model.planes == "auto":
            common["planes"] = self.planes
        return model.model_copy(update=common | {"device": self.device})

    def for_recordings(self, recordings: Iterable[Recording]) -> Self:
        """Return the options with `planes` as the recordings say, where it is `auto`."""
        return self.model_copy(update={"planes": resolved_planes(self.planes, recordings)})

    def against_garbage(self, inspection: Inspection | None) -> Self:
        """Return the options with the pixels and weights that a training would choose by itself.

        Where garbage bends a fit, all models are measured on the largest plane of each image, and
        fitted to it with robust weights. A model that chooses its pixels or robust weights keeps
        them, and so do options that choose the pixels.
        """
        if inspection is None or not (masks := masks_against_garbage(self, inspection)):
            return self
        models = tuple(against_garbage(model, inspection) for model in self.models)
        return self.model_copy(update=masks | {"models": models})

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values; of each model only the keys that it sets, as reading them needs."""
        models = [one.model_dump(mode="json", include=one.model_fields_set) for one in self.models]
        return self.model_dump(mode="json") | {"models": models}


class RepeatOptions(Options):
    """Repeated random splits.

    Attributes:
        number: How many; 0 leaves them out.
        test_fraction: Share of the poses held out each time.
    """

    number: NonNegativeInt = 0
    test_fraction: float = Field(default=1 / 3, gt=0.0, lt=1.0)


class EvaluationOptions(ComparisonOptions):
    """The options of `tofcorr evaluate`.

    Attributes:
        test_fraction: Share of the poses held out in the single split of the first table.
        folds: Folds of the cross-validation in the second table; 0 leaves it out.
        repeats: Further random splits.
        walls: Whether each wall is held out in turn as well; where walls are estimated, its plane
            alone is found in its own images.
    """

    config_folder: ClassVar[str] = "evaluate"
    baselines: ClassVar[tuple[str, ...]] = (BEFORE, HAND_EYE_ONLY)

    test_fraction: float = Field(default=0.5, gt=0.0, lt=1.0)
    folds: NonNegativeInt = 6
    repeats: RepeatOptions = RepeatOptions()
    walls: bool = False

    @model_validator(mode="after")
    def _folds_can_be_fitted(self) -> Self:
        if self.folds == 1:
            raise ValueError("one fold leaves nothing to train on; expected 0 or at least 2 folds")
        return self

    def splits(self, dataset: Dataset) -> tuple[Splits, dict[str, str]]:
        """Return the splits of each protocol that was asked for; the half split always.

        A random half split (Table 1 of Abdo and Borgeat 2010), k-fold cross-validation by image
        (their Table 2) and repeated random splits.
        """

        def drawn(fraction: float, seed: int) -> np.ndarray:
            return split_frames(dataset, SplitOptions(test_fraction=fraction, seed=seed))[1]

        found: Splits = {"half": {"half": drawn(self.test_fraction, self.seed)}}
        if self.folds:
            found["folds"] = _by_image(dataset, self.folds, self.seed)
        repeats = self.repeats
        if repeats.number:
            seeds = np.random.SeedSequence(self.seed).generate_state(repeats.number)
            tests = [drawn(repeats.test_fraction, seed) for seed in seeds.tolist()]
            found["repeats"] = {f"repeat {k}": test for k, test in enumerate(tests, start=1)}
        targets = _by_target(dataset)
        return found | ({"walls": targets} if self.walls and len(targets) > 1 else {}), {}

    def overlap(self, protocol: str) -> float:
        """Return what random splits have in common."""
        share = self.repeats.test_fraction
        return share / (1 - share) if protocol == "repeats" else 0.0


class SelectionOptions(ComparisonOptions):
    """The options of `tofcorr select`.

    Attributes:
        by: What is held out in turn: some images, a band of distances, a target. The first
            decides; the others show whether its choice also extrapolates.
        folds: Number of groups into which the images are divided.
        distance_bands: Number of bands of distance, of about as many images each.
        metric: Which error counts.
    """

    config_folder: ClassVar[str] = "select"

    by: tuple[Grouping, ...] = Field(default=("image", "distance", "target"), min_length=1)
    folds: int = Field(default=6, ge=2)
    distance_bands: int = Field(default=3, ge=2)
    metric: Literal["mean_abs", "rms"] = "mean_abs"

    def splits(self, dataset: Dataset) -> tuple[Splits, dict[str, str]]:
        """Return the groups of frames to hold out in turn: images, bands of distance, or targets.

        Raises:
            CalibrationDataError: None of them is possible.
        """
        found: Splits = {}
        skipped: dict[str, str] = {}
        poses = dataset.pose_groups()
        ways: dict[Grouping, Callable[[], dict[str, np.ndarray]]] = {
            "image": lambda: _by_image(dataset, self.folds, self.seed),
            "distance": lambda: _by_distance(dataset, self.distance_bands),
            "target": lambda: _by_target(dataset),
        }
        for by in self.by:
            try:
                groups = ways[by]()
            except CalibrationDataError as error:
                skipped[by] = str(error)
                continue
            left = {name: len(np.unique(np.delete(poses, test))) for name, test in groups.items()}
            scarce = min(left, key=left.__getitem__)
            if len(groups) < 2:
                skipped[by] = f"the recording has one {by} only."
            # Three tilted views are the least that determine a hand-eye transform from planes; the
            # fit itself refuses what more unknowns need.
            elif left[scarce] < 3:
                skipped[by] = f"without {scarce} {left[scarce]} poses are left, 3 are needed."
            else:
                found[by] = groups
        if not found:
            why = f"no images can be held out to compare the models: {' '.join(skipped.values())}"
            raise CalibrationDataError(f"{dataset.first.path}: {why}")
        return found, skipped


def _by_target(dataset: Dataset) -> dict[str, np.ndarray]:
    names = np.unique(dataset.targets)
    return {str(name): np.flatnonzero(dataset.targets == name) for name in names}


def _by_image(dataset: Dataset, number: int, seed: int) -> dict[str, np.ndarray]:
    return {f"fold {k}": test for k, test in enumerate(folds(dataset, number, seed), start=1)}


def _by_distance(dataset: Dataset, bands: int) -> dict[str, np.ndarray]:
    # Each frame's median measured distance; no usable pixel: infinite.
    distance = np.full(dataset.num_frames, np.inf)
    for batch in dataset.batches():
        for k, frame in enumerate(batch.indices.tolist()):
            usable = batch.radial_distance[k][batch.valid[k]]
            distance[frame] = float(usable.median()) if usable.numel() else np.inf
    poses = dataset.pose_groups()
    of_pose = np.array([np.median(distance[poses == pose]) for pose in range(poses.max() + 1)])
    order = np.argsort(of_pose, kind="stable")
    found = {}
    for band in np.array_split(order, min(bands, len(order))):
        ends = f"{of_pose[band].min():.2f} to {of_pose[band].max():.2f} m"
        found[ends] = np.flatnonzero(np.isin(poses, band))
    return found


def masks_of(options: MaskOptions) -> MaskOptions:
    """Return only the options that say which pixels are used; equal ones compare as equal."""
    return MaskOptions(**{name: getattr(options, name) for name in MaskOptions.model_fields})


def comparability_notes(options: ComparisonOptions) -> list[str]:
    """Say how the models were fitted and on what all of them were measured.

    Returns:
        Sentences; none if all models share pixels, planes and weights, so that their fits differ
        in nothing but the model.
    """
    common = masks_of(options)
    fits = [_how_fitted(options.training(model), common) for model in options.models]
    if not any(fits):
        return []
    said = f"All models are measured on the same held-out pixels ({_pixels(common)}), all of the"
    said = f"{said} same weight, against the recorded planes"
    if options.planes != "known":
        said = f"{said}, or the walls that a model estimated in its training images"
    return [*filter(None, fits), f"{said}."]


def _how_fitted(training: TrainingOptions, common: MaskOptions) -> str:
    """Return how a model was fitted, where that is not how all are; else an empty text."""
    weights, other = training.weights, masks_of(training) != common
    differences = (
        (other, f"to other pixels than those measured ({_pixels(training)})"),
        (weights.noise, "with pixels weighted by their noise"),
        (weights.robust != "none", f"with robust weights ({weights.robust})"),
        (training.planes == "unknown", "with estimated walls"),
    )
    said = ", ".join(words for differs, words in differences if differs)
    return f"{training.name} was fitted {said}." if said else ""


def _pixels(masks: MaskOptions) -> str:
    """Return which pixels the masks leave: the options that are no default, as they are written."""
    chosen = masks_of(masks).model_dump(exclude_defaults=True).items()
    return ", ".join(["the recording's mask", *(f"{name}: {value}" for name, value in chosen)])
