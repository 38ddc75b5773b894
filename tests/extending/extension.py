"""What the pieces of code did that ran in the extended package."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Extension:
    """The extended package, after every piece of code was run in it.

    Attributes:
        root: The folder that holds the copied package, and a folder for each piece.
        outcomes: What each piece printed, and the traceback of its error, if any.
    """

    root: Path
    outcomes: dict[str, tuple[str, str]]

    def printed_by(self, piece: str) -> str:
        """Return what a piece printed; it must have run without an error."""
        printed, error = self.outcomes[piece]
        assert not error, error
        return printed

    def folder_of(self, piece: str) -> Path:
        """Return the folder that a piece worked in; it must have run without an error."""
        self.printed_by(piece)
        return self.root / piece
