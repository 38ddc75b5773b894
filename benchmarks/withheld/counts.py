"""How many recordings of each kind a command line asks for."""

from collections.abc import Collection

import click


def counts_by_name(text: str, cases: int, known: Collection[str], what: str) -> dict[str, int]:
    """Return the number of each kind from text such as `A,B,C:400`.

    Args:
        text: Names; a number behind a colon replaces `cases`.
        cases: How many of a name without a number.
        known: The names that there are.
        what: What a name names, for the refusal.

    Raises:
        BadParameter: A name is unknown.
    """
    counts = {}
    for part in text.split(","):
        name, _, number = part.strip().partition(":")
        if name not in known:
            raise click.BadParameter(f"no {what} {name!r}: expected some of {', '.join(known)}")
        counts[name] = int(number) if number else cases
    return counts
