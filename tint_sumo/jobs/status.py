"""Status of jobs: how far and how fast those are that run, and how long all will take."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Progress


@dataclass(frozen=True)
class StatusText:
    """The status of a running job for people to read; what is not known is empty."""

    percent: str = ""
    speed: str = ""
    left: str = ""
    outcomes: str = ""


@dataclass(frozen=True)
class Status:
    """The status of a running job; its times are those of one clock."""

    began_s: float
    first: Progress | None = None  # an earlier run's share of the work says nothing about the speed of this run
    first_s: float = 0.0
    last: Progress | None = None
    last_s: float = 0.0

    def after(self, progress: Progress, now_s: float) -> "Status":
        if self.first is None:
            return replace(self, first=progress, first_s=now_s, last=progress, last_s=now_s)
        return replace(self, last=progress, last_s=now_s)

    @property
    def speed(self) -> float:
        """Units per second; 0 as long as nothing is known."""
        if self.first is None or self.last is None or self.last_s <= self.first_s:
            return 0.0
        return (self.last.done - self.first.done) / (self.last_s - self.first_s)

    def left_s(self, now_s: float) -> float | None:
        """Return the time left, None if it is not known."""
        if self.last is None or self.speed <= 0.0:
            return None
        return max((self.last.total - self.last.done) / self.speed - (now_s - self.last_s), 0.0)

    def text(self, now_s: float) -> StatusText:
        if self.last is None:
            return StatusText()
        left_s = self.left_s(now_s)
        return StatusText(
            f"{percent(self.last.done / self.last.total, 0)}%",
            "" if left_s is None else f"{_rounded(self.speed)} {self.last.unit}s/s",
            "" if left_s is None else duration(left_s),
            self.last.outcomes,
        )


@dataclass
class Overview:
    """All jobs, by name: those that wait, those that run, how long others took, and how many were given up."""

    total: int
    waiting: list[str]
    running: dict[str, Status] = field(default_factory=dict)
    took_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by task
    given_up: int = 0

    @property
    def done(self) -> int:
        return self.total - self.given_up - len(self.waiting) - len(self.running)

    def left_s(self, now_s: float) -> float | None:
        """Return how long all will take, if a job takes as long as others of its task; None if no time is known yet."""
        times_s = self._times_s(now_s)
        all_s = [time_s for times in times_s.values() for time_s in times]
        if not all_s:
            return None
        running_s = []
        for name, status in self.running.items():
            left_s = status.left_s(now_s)
            typical_s = _mean(times_s.get(task_of(name), all_s))
            running_s.append(max(typical_s - (now_s - status.began_s), 0.0) if left_s is None else left_s)
        waiting_s = sum(_mean(times_s.get(task_of(name), all_s)) for name in self.waiting)
        return max([*running_s, (sum(running_s) + waiting_s) / max(len(running_s), 1)])

    def _times_s(self, now_s: float) -> dict[str, list[float]]:
        """Return by task how long jobs took that have ended, and how long those will have taken that run."""
        times_s = {task: list(times) for task, times in self.took_s.items()}
        for name, status in self.running.items():
            left_s = status.left_s(now_s)
            if left_s is not None:
                times_s.setdefault(task_of(name), []).append(now_s - status.began_s + left_s)
        return times_s


def task_of(name: str) -> str:
    """Return the first word of a job's name: jobs of one task are expected to take equally long."""
    return name.split(" ", maxsplit=1)[0]


def duration(seconds: float) -> str:
    """Return a time for people to read."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _rounded(speed: float) -> str:
    return f"{speed:,.0f}" if speed >= 10.0 else f"{speed:.2g}"


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)
