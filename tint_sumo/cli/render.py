"""``tint-sumo render``."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tint_sumo.cli.command import Outcome, use_one_thread
from tint_sumo.cli.own_network import NetworkCommand
from tint_sumo.cli.policy import content_of, task_of
from tint_sumo.cli.values import PolicyName, TestMix, TestScene, TestSensor, TestTau, WorldName
from tint_sumo.config import NoiseM, Seed
from tint_sumo.core.ranges import Range


@dataclass(frozen=True, kw_only=True)
class Render(NetworkCommand):
    """Film one test episode (case): the drivers' traits, those that the policy infers, its attention and actions."""

    model: PolicyName
    out: Path
    """Film to write, .mp4 (needs tint_sumo[video]) or .gif, or a strip of eight moments, .png."""
    p_conservative: TestMix = None
    case: Annotated[int, Range(0, 999_999)] = 0
    """Number of the case; the same cases as in policy evaluate."""
    seed: Seed = 0
    """Number of the case set, 0 to 1000."""
    world: WorldName = None
    scene: TestScene = None
    sensor: TestSensor = None
    noise: NoiseM = 0.0
    """Standard deviation of the noise on the others' positions, m, with a sensor that has none; the film
    shows them without noise."""
    tau: TestTau = None
    allow_pickle: bool = False
    """Read .zip files, which can run any code: for files that you trust alone."""

    def run(self) -> Outcome:
        from tint_sumo.films.film import render_case, require_film_file
        from tint_sumo.jobs.table import one_job
        from tint_sumo.methods.loading import load_policy

        require_film_file(self.out)
        use_one_thread()
        contender = load_policy(self.model, scene=self.scene_of(self.scene), allow_pickle=self.allow_pickle)
        task = task_of(contender, self.p_conservative, self.sensor, self.noise, self.tau, self.world)
        with one_job(f"render {self.out}") as report:
            film = render_case(contender, self.case, self.out, case_set=self.seed, task=task, report=report)
        text = f"{film.outcome} after {film.time_s:.1f} s, {film.frames} frames: {self.out}"
        content = {"model": self.model, **content_of(task), "case": self.case, "seed": self.seed}
        return Outcome(text, {**content, "out": str(self.out), **asdict(film)})
