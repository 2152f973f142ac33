"""``tint-sumo render``."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from tint_sumo.cli.command import Outcome, use_one_thread
from tint_sumo.cli.policy import PolicyCommand
from tint_sumo.config import NoiseM, Seed
from tint_sumo.core.ranges import Range

_NOISE = arg(
    help="Standard deviation of the noise on the others' positions, m, with a sensor that has none; the film shows "
    "them without noise."
)


@dataclass(frozen=True, kw_only=True)
class Render(PolicyCommand):
    """Film one test episode (case): the drivers' traits, those that the policy infers, its attention and actions."""

    out: Path
    """Film to write, .mp4 (needs tint_sumo[video]) or .gif, or a strip of eight moments, .png."""
    case: Annotated[int, Range(0, 999_999)] = 0
    """Number of the case; the same cases as in policy evaluate."""
    seed: Seed = 0
    """Number of the case set, 0 to 1000."""
    noise: Annotated[NoiseM, _NOISE] = 0.0

    def run(self) -> Outcome:
        from tint_sumo.films.film import render_case, require_film_file
        from tint_sumo.jobs.table import one_job

        require_film_file(self.out)
        use_one_thread()
        contender, task = self.load()
        with one_job(f"render {self.out}") as report:
            film = render_case(contender, self.case, self.out, case_set=self.seed, task=task, report=report)
        text = f"{film.outcome} after {film.time_s:.1f} s, {film.frames} frames: {self.out}"
        content = {**self.content_of(task), "case": self.case, "seed": self.seed}
        return Outcome(text, {**content, "out": str(self.out), **asdict(film)})
