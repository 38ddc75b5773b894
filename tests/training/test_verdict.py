"""What the verdict of a run says of errors that the model does not describe."""

import math

import pytest

from tofcorr.training.verdict import beyond_noise


@pytest.mark.parametrize(
    ("held_out", "noise", "words"),
    [
        (5.0, 3.0, "4.0 mm beyond the noise"),
        (5.0, 4.5, None),  # 2.2 mm, half of the noise
        (1.6, 0.8, None),  # 1.4 mm
        (3.0, 3.5, None),
        (None, 3.0, None),
        (5.0, math.nan, None),
    ],
)
def test_an_error_beyond_the_noise_is_named_where_it_is_large(
    held_out: float | None, noise: float, words: str | None
) -> None:
    """A wedge before the lens moved the hand-eye by 14 mm; the run was `good` and said 3.7."""
    found = beyond_noise(held_out, noise)
    assert (found is None) == (words is None)
    assert words is None or words in str(found)
