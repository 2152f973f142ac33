"""Shares for people to read, in percent."""

import math
from decimal import ROUND_HALF_UP, Decimal


def percent(share: float, digits: int = 1) -> str:
    """Return a share of 1 in percent, without the sign, rounded half up: 0.985 is "98.5", and "99" without digits.

    Only a share of 1 reads 100, and only one of 0 reads 0: 0.9996 is ">99.9" and 0.0002 is "<0.1".
    An unknown share (NaN) is "-".

    Args:
        share: in 0 to 1.
        digits: behind the point.
    """
    if math.isnan(share):
        return "-"
    unit = Decimal(1).scaleb(-digits)
    exact = 100 * Decimal(repr(float(share)))  # the shortest decimal number, which is the one that was meant
    rounded = exact.quantize(unit, ROUND_HALF_UP)
    if rounded >= 100 > exact:
        return f">{100 - unit}"
    if rounded <= 0 < exact:
        return f"<{unit}"
    return str(rounded)


def percent_and_ends(share: float, ends: tuple[float, float], digits: int = 1) -> str:
    """Return a share with the ends of its interval, all as ``percent`` has them: "98.5 [97.0, 99.2]"."""
    low, high = ends
    return f"{percent(share, digits)} [{percent(low, digits)}, {percent(high, digits)}]"
