"""What a fit of the module found."""

from dataclasses import dataclass, field

_HEADINGS = ("before", "hand-eye only", "after")


@dataclass(frozen=True, kw_only=True)
class ErrorMM:
    """Distances of points to their planes, millimetres; NaN without frames.

    Attributes:
        mean_abs: Mean absolute distance.
        rms: Root mean square distance.
    """

    mean_abs: float
    rms: float


@dataclass(frozen=True, kw_only=True, repr=False)
class FitReport:
    """What `DepthCorrection.fit` found; printing it gives the summary.

    Attributes:
        model: The model's name.
        before: Error of held-out frames as recorded, with the recorded hand-eye transform.
        hand_eye_only: The same with the best hand-eye transform and no depth correction.
        after: The same with hand-eye transform and depth correction.
        held_out: Whether the errors are of held-out frames; if not, of the frames fitted.
        tool_from_camera: The hand-eye transform, 4 rows of 4, metres.
        translation_se_mm: Its standard errors along the tool's axes, millimetres.
        rotation_se_deg: Its standard errors about the tool's axes, degrees.
        stopped: Why the solver stopped; only "converged" is convergence.
        iterations: How many iterations it took.
        train_frames: Numbers of the frames fitted.
        test_frames: Numbers of the frames held out.
        warnings: What to know before the result is trusted, one sentence each.
    """

    model: str
    before: ErrorMM
    hand_eye_only: ErrorMM
    after: ErrorMM
    held_out: bool
    tool_from_camera: tuple[tuple[float, ...], ...]
    translation_se_mm: tuple[float, ...]
    rotation_se_deg: tuple[float, ...]
    stopped: str
    iterations: int
    train_frames: tuple[int, ...] = field(default=())
    test_frames: tuple[int, ...] = field(default=())
    warnings: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        """Return the errors as a table, the hand-eye transform and the warnings."""
        frames = self.test_frames if self.held_out else self.train_frames
        kind = "held-out" if self.held_out else "fitted"
        lines = [
            f"{self.model}: {self.stopped} after {self.iterations} iterations, "
            f"{len(self.train_frames)} frames fitted",
            f"{f'error of {len(frames)} {kind} frames, mm':<34}{'mean abs':>10}{'rms':>10}",
        ]
        for name, error in zip(_HEADINGS, self._stages(), strict=True):
            lines.append(f"  {name:<32}{error.mean_abs:>10.2f}{error.rms:>10.2f}")
        position = [1e3 * row[3] for row in self.tool_from_camera[:3]]
        lines.append(f"hand-eye: t = {_numbers(position, 1)} mm")
        lines.append(
            f"  standard errors: {_numbers(self.translation_se_mm, 2)} mm, "
            f"{_numbers(self.rotation_se_deg, 3)} deg"
        )
        return "\n".join([*lines, *(f"warning: {text}" for text in self.warnings)])

    def _stages(self) -> tuple[ErrorMM, ErrorMM, ErrorMM]:
        return self.before, self.hand_eye_only, self.after


def _numbers(values: tuple[float, ...] | list[float], digits: int) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in values) + ")"
