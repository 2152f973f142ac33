"""Where jobs stand that are being done, how fast they are, and how long all will take."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Progress


@dataclass(frozen=True)
class Title:
    """What a job is; no two jobs of a table have the same title."""

    task: str
    method: str = ""
    mix: str = ""  # P(conservative)
    seed: int | None = None

    @property
    def work(self) -> str:
        return f"{self.task} {self.method}".strip()

    @property
    def circumstances(self) -> str:
        mix = f"mix {self.mix}" if self.mix else ""
        seed = "" if self.seed is None else f"seed {self.seed}"
        return ", ".join(part for part in (mix, seed) if part)

    def __str__(self) -> str:
        return ", ".join(part for part in (self.work, self.circumstances) if part)


@dataclass(frozen=True)
class Words:
    """Where a job stands, for people to read; what is not known is empty."""

    percent: str = ""
    speed: str = ""
    left: str = ""
    outcomes: str = ""


@dataclass(frozen=True)
class Standing:
    """Where a job stands that is being done; its times are those of one clock."""

    title: Title
    began_s: float
    first: Progress | None = None  # what an earlier run did says nothing about this one's speed
    first_s: float = 0.0
    last: Progress | None = None
    last_s: float = 0.0

    def after(self, progress: Progress, now_s: float) -> "Standing":
        if self.first is None:
            return replace(self, first=progress, first_s=now_s, last=progress, last_s=now_s)
        return replace(self, last=progress, last_s=now_s)

    @property
    def speed(self) -> float:
        """Units a second; 0 as long as nothing is known."""
        if self.first is None or self.last is None or self.last_s <= self.first_s:
            return 0.0
        return (self.last.done - self.first.done) / (self.last_s - self.first_s)

    def left_s(self, now_s: float) -> float | None:
        """None if it is not known."""
        if self.last is None or self.speed <= 0.0:
            return None
        return max((self.last.total - self.last.done) / self.speed - (now_s - self.last_s), 0.0)

    def words(self, now_s: float) -> Words:
        if self.last is None:
            return Words()
        left_s = self.left_s(now_s)
        return Words(
            f"{percent(self.last.done / self.last.total, 0)}%",
            "" if left_s is None else f"{_rounded(self.speed)} {self.last.unit}s/s",
            "" if left_s is None else duration(left_s),
            self.last.outcomes,
        )


@dataclass
class Overview:
    """All jobs: those that wait, those that are being done, how long others took, and how many were given up."""

    total: int
    waiting: list[Title]
    standings: dict[Title, Standing] = field(default_factory=dict)
    took_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by task
    given_up: int = 0

    @property
    def done(self) -> int:
        return self.total - self.given_up - len(self.waiting) - len(self.standings)

    def left_s(self, now_s: float) -> float | None:
        """How long all will take, if a job takes as long as others of its task; None if no time is known yet."""
        times_s = self._times_s(now_s)
        of_any = [one for times in times_s.values() for one in times]
        if not of_any:
            return None
        running_s = []
        for title, standing in self.standings.items():
            left_s = standing.left_s(now_s)
            typical_s = _mean(times_s.get(title.task, of_any))
            running_s.append(max(typical_s - (now_s - standing.began_s), 0.0) if left_s is None else left_s)
        waiting_s = sum(_mean(times_s.get(title.task, of_any)) for title in self.waiting)
        return max([*running_s, (sum(running_s) + waiting_s) / max(len(running_s), 1)])

    def _times_s(self, now_s: float) -> dict[str, list[float]]:
        """By task, how long the jobs took that have ended, and how long those will have taken that are being done."""
        times_s = {task: list(times) for task, times in self.took_s.items()}
        for title, standing in self.standings.items():
            left_s = standing.left_s(now_s)
            if left_s is not None:
                times_s.setdefault(title.task, []).append(now_s - standing.began_s + left_s)
        return times_s


def duration(seconds: float) -> str:
    """A time for people to read."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _rounded(speed: float) -> str:
    return f"{speed:,.0f}" if speed >= 10.0 else f"{speed:.2g}"


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)
