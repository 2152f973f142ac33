"""Jobs for tests of executors; run as a program, jobs that must be interrupted unless they are short."""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.core.files import write_text
from tint_sumo.core.processes import interrupt_on_sigterm
from tint_sumo.core.progress import Progress, Report
from tint_sumo.jobs import Local

SAVING_S = 0.2  # longer than a signal takes that comes a second time
GATE_S = 120.0  # a test that has failed opens no gate


@dataclass(frozen=True)
class FileJob:
    """Writes its start and end into files named after it; ``patience_s`` lies between them."""

    name: str
    out: Path
    needs: tuple[str, ...] = ()
    reports: int = 1
    patience_s: float = 0.0
    failure: str = ""

    uses_gpu = False

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(f"{one}.done" for one in self.needs)

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(f"{self.name}.{state}" for state in ("pid", "tries", "interrupted", "done"))

    def path(self, state: str) -> Path:
        return self.out / f"{self.name}.{state}"

    @property
    def tries(self) -> int:
        """Number of times that it was begun."""
        return int(self.path("tries").read_text()) if self.path("tries").exists() else 0

    def is_done(self) -> bool:
        return self.path("done").exists()

    def run(self, report: Report) -> str:
        write_text(self.path("tries"), str(self.tries + 1))
        try:
            return self._run(report)
        except KeyboardInterrupt:
            time.sleep(SAVING_S)
            write_text(self.path("interrupted"), "")
            raise

    def _run(self, report: Report) -> str:
        write_text(self.path("pid"), str(os.getpid()))
        for done in range(self.reports):
            report(Progress(done, self.reports, "line", {"success": 0.5}))
            time.sleep(0.3 * (self.reports > 1))
        if self.failure == "diverged":
            raise DivergedError("at step 7")
        if self.failure == "refused":
            raise InputError("this is not for me")
        if self.failure == "died" or (self.failure == "died once" and self.tries == 1):
            os._exit(7)
        time.sleep(self.patience_s)
        missing = [one for one in self.needs if not (self.out / f"{one}.done").exists()]
        write_text(self.path("done"), " ".join(missing))
        return "written"


@dataclass(frozen=True)
class CountJob:
    """Counts to ``end`` and keeps every number, and the first one of each run, from which it goes on.

    It is not done before there is a file ``gate``: however slow a machine is, tests find it at work.
    """

    name: str
    out: Path
    end: int
    gate: Path | None = None

    needs = ()
    inputs = ()
    uses_gpu = False

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.name, f"{self.name}.done"

    @property
    def numbers(self) -> list[int]:
        """Those that it has counted, one after the other."""
        return sorted(int(file.name) for file in (self.out / self.name).glob("[0-9]*"))

    @property
    def begins(self) -> list[int]:
        """Numbers with which its runs began, as far as they are known."""
        return sorted(int(file.name.removeprefix("from-")) for file in (self.out / self.name).glob("from-*"))

    def is_done(self) -> bool:
        return (self.out / f"{self.name}.done").exists()

    def run(self, report: Report) -> str:
        first = max(self.numbers, default=-1) + 1
        write_text(self.out / self.name / f"from-{first}", "")
        for number in range(first, self.end):
            time.sleep(0.1)
            if number == self.end - 1:
                self._wait_at_gate()
            write_text(self.out / self.name / str(number), str(number))
            report(Progress(number + 1, self.end, "number"))
        write_text(self.out / f"{self.name}.done", "")
        return "counted"

    def _wait_at_gate(self) -> None:
        end_s = time.monotonic() + GATE_S
        while self.gate is not None and not self.gate.exists() and time.monotonic() < end_s:
            time.sleep(0.05)


if __name__ == "__main__":
    interrupt_on_sigterm()
    folder, is_short = Path(sys.argv[1]), "short" in sys.argv
    times = {"reports": 3} if is_short else {"patience_s": 60.0}
    try:
        Local(2).run([FileJob(name, folder, **times) for name in ("first", "second")])
    except KeyboardInterrupt:
        sys.exit(130)
