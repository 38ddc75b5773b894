"""Quantiles and tails of Student's t and F, without `scipy.stats`, which takes long to import.

`scipy.special` takes a sixth of the time of torch: it is imported by the first call.
"""


def student_quantile(probability: float, degrees_of_freedom: float | int) -> float:
    """Return the value that t stays below with a probability; NaN without a degree of freedom.

    Example:
        >>> round(student_quantile(0.975, 10), 4)
        2.2281
    """
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, probability))


def student_tail(value: float, degrees_of_freedom: float | int) -> float:
    """Return the probability of t above a value; NaN without a degree of freedom.

    Example:
        >>> round(student_tail(2.2281, 10), 4)
        0.025
    """
    from scipy.special import stdtr

    return float(stdtr(degrees_of_freedom, -value))


def f_tail(ratio: float, above: float | int, below: float | int) -> float:
    """Return the probability that F, a ratio of two mean squares, exceeds a value.

    Args:
        ratio: The value.
        above: Degrees of freedom of the mean square above.
        below: Of the one below.

    Example:
        >>> round(f_tail(3.7083, 3, 10), 4)
        0.05
    """
    from scipy.special import fdtrc

    return float(fdtrc(above, below, ratio))
