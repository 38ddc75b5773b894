"""Views that pass every step of an import, and those that a step refuses."""

from collections.abc import Callable, Iterable
from typing import TypeVar

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.report import Refusal, RefusedViewError

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[Iterable[Item], str], Iterable[Item]]
"""Wraps an iterable to show how far a step (named by the text) has come."""


def no_progress(items: Iterable[Item], _: str) -> Iterable[Item]:
    """Show nothing."""
    return items


class Sieve:
    """Applies the steps of an import to its views and collects the refusals.

    Args:
        source: What the views are read from, for messages.
        progress: Shows how far a step has come.

    Attributes:
        refused: The views refused so far, with reasons.
    """

    def __init__(self, source: str, progress: Progress = no_progress) -> None:
        self._source = source
        self.progress = progress
        self.refused: list[Refusal] = []

    def apply(
        self, step: Callable[[Item], Result], views: Iterable[Item], name: Callable[[Item], str]
    ) -> list[Result]:
        """Apply `step` to each view and leave out those that it refuses.

        Args:
            step: Raises `RefusedViewError` for a view that cannot be used.
            views: The views.
            name: Returns the name of a view, for its refusal.

        Raises:
            CalibrationDataError: No view is left.
        """
        results = []
        for view in views:
            try:
                results.append(step(view))
            except RefusedViewError as refusal:
                self.refused.append(Refusal(view=name(view), reason=str(refusal)))
        if not results:
            raise CalibrationDataError(
                f"{self._source}: none of {len(self.refused)} views can be imported; the first: "
                f"{self.refused[0].reason}."
            )
        return results
