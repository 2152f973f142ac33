"""Progress of work that takes long, as it is reported."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from tint_sumo.core.percentages import percent

_SHARES = ("success", "timeout", "collision", "accuracy")  # measures that people read in percent


@dataclass(frozen=True)
class Progress:
    """Progress of a piece of work."""

    done: int
    total: int
    unit: str  # what is counted, in the singular
    measures: Mapping[str, float] = field(default_factory=dict)  # results so far, by name

    @property
    def outcomes(self) -> str:
        """The measures for people to read."""
        shown = (
            f"{percent(value, 0)}%" if name in _SHARES else f"{value:.3g}" for name, value in self.measures.items()
        )
        return ", ".join(f"{name} {value}" for name, value in zip(self.measures, shown, strict=True))


Report = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Report to nobody."""


def part_of(report: Report, before: int, total: int) -> Report:
    """Return a report for a part of some work, of which ``before`` of ``total`` was done when the part began."""
    return lambda progress: report(replace(progress, done=before + progress.done, total=total))
