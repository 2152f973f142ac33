"""Rates of outcomes with their uncertainty. Pure functions."""

import math
from dataclasses import dataclass

Z_95 = 1.959963984540054  # standard normal quantile of a two-sided 95 % interval


@dataclass(frozen=True)
class Rate:
    """``count`` of ``total`` cases, as a fraction with its 95 % Wilson interval."""

    count: int
    total: int

    @property
    def value(self) -> float:
        return self.count / self.total

    @property
    def interval(self) -> tuple[float, float]:
        return wilson_interval(self.count, self.total)


def wilson_interval(count: int, total: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson score interval of a binomial proportion (Wilson 1927, JASA 22, 209-212), as fractions.

    Raises:
        ValueError: no cases, or a count outside 0..total.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"{count} of {total} cases is no rate")
    rate = count / total
    denominator = 1.0 + z * z / total
    centre = rate + z * z / (2.0 * total)
    spread = z * math.sqrt(rate * (1.0 - rate) / total + z * z / (4.0 * total * total))
    # Rounding must not move the ends past 0, 1 or the rate itself.
    low = min(max((centre - spread) / denominator, 0.0), rate)
    high = max(min((centre + spread) / denominator, 1.0), rate)
    return low, high
