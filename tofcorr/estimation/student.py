"""Quantiles and tails of Student's t, without `scipy.stats`, which takes a second to import."""

from scipy.special import stdtr, stdtrit


def student_quantile(probability: float, degrees_of_freedom: float | int) -> float:
    """Return the value that t stays below with a probability; NaN without a degree of freedom.

    Example:
        >>> round(student_quantile(0.975, 10), 4)
        2.2281
    """
    return float(stdtrit(degrees_of_freedom, probability))


def student_tail(value: float, degrees_of_freedom: float | int) -> float:
    """Return the probability of t above a value; NaN without a degree of freedom.

    Example:
        >>> round(student_tail(2.2281, 10), 4)
        0.025
    """
    return float(stdtr(degrees_of_freedom, -value))
