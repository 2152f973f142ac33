"""Jobs for tests of the pool; run as a program, a pool that must be interrupted unless its jobs are short."""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tint_sumo.errors import InputError
from tint_sumo.files import write_text
from tint_sumo.progress import Progress, Report
from tint_sumo.standings import Title
from tint_sumo.study.pool import run_jobs


@dataclass(frozen=True)
class FileJob:
    """Writes its start and end into files named after it; ``patience_s`` lies between them."""

    name: str
    folder: Path
    needs: tuple[str, ...] = ()
    reports: int = 1
    patience_s: float = 0.0
    failure: str = ""

    def path(self, state: str) -> Path:
        return self.folder / f"{self.name}.{state}"

    @property
    def title(self) -> Title:
        return Title(self.name)

    def is_done(self) -> bool:
        return self.path("done").exists()

    def run(self, report: Report) -> str:
        write_text(self.path("pid"), str(os.getpid()))
        for done in range(self.reports):
            report(Progress(done, self.reports, "line", {"success": 0.5}))
            time.sleep(0.3 * (self.reports > 1))
        if self.failure == "refused":
            raise InputError("this is not for me")
        if self.failure == "died":
            os._exit(7)
        try:
            time.sleep(self.patience_s)
        except KeyboardInterrupt:
            write_text(self.path("interrupted"), "")
            raise
        missing = [one for one in self.needs if not (self.folder / f"{one}.done").exists()]
        write_text(self.path("done"), " ".join(missing))
        return "written"


if __name__ == "__main__":
    folder, is_short = Path(sys.argv[1]), "short" in sys.argv
    times = {"reports": 3} if is_short else {"patience_s": 60.0}
    try:
        run_jobs([FileJob(name, folder, **times) for name in ("first", "second")], workers=2)
    except KeyboardInterrupt:
        sys.exit(130)
