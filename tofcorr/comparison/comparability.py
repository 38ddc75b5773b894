"""What a reader must know to compare models that were fitted differently: in sentences."""

from tofcorr.comparison.comparison_options import ComparisonOptions, masks_of
from tofcorr.pixels.masks import MaskOptions
from tofcorr.training.options import TrainingOptions


def comparability_notes(options: ComparisonOptions) -> list[str]:
    """Say how the models were fitted and on what all of them were measured.

    Returns:
        Sentences; none if all models share pixels, planes and weights, so that their fits differ
        in nothing but the model.
    """
    common = masks_of(options)
    trainings = [options.training(model) for model in options.models]
    differing = [sentence for training in trainings if (sentence := _how_fitted(training, common))]
    if not differing:
        return []
    judged = (
        "the recorded planes"
        if options.planes == "known"
        else "the recorded planes, or the walls that a model estimated in its training images"
    )
    return [
        *differing,
        f"All models are measured on the same held-out pixels ({_pixels(common)}), all of the same "
        f"weight, against {judged}.",
    ]


def _how_fitted(training: TrainingOptions, common: MaskOptions) -> str:
    """Return how a model was fitted, where that is not how all are; else an empty text."""
    weights = training.weights
    said = []
    if masks_of(training) != common:
        said.append(f"to other pixels than those measured ({_pixels(training)})")
    if weights.noise:
        said.append("with pixels weighted by their noise")
    if weights.robust != "none":
        said.append(f"with robust weights ({weights.robust})")
    if training.planes == "unknown":
        said.append("with estimated walls")
    return f"{training.name} was fitted {', '.join(said)}." if said else ""


def _pixels(masks: MaskOptions) -> str:
    """Return in words which pixels the masks leave."""
    said = ["the recording's mask"]
    if masks.outlier_window_mm is not None:
        said.append(f"raw error within {masks.outlier_window_mm:g} mm of the median")
    if masks.mask == "ransac":
        said.append(f"within {masks.mask_tolerance_mm:g} mm of the image's largest plane")
    if masks.edge_contrast is not None:
        said.append(f"off edges of contrast {masks.edge_contrast:g}")
    if masks.grazing_deg is not None:
        said.append(f"seen at less than {masks.grazing_deg:g} degrees")
    return ", ".join(said)
