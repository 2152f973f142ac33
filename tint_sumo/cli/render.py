"""``tint-sumo render``."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tint_sumo.cli.command import Command, Outcome, use_one_thread
from tint_sumo.cli.policy import world_of
from tint_sumo.cli.values import MixFlag, SceneValue
from tint_sumo.config import NoiseM, Seed, TauS
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import plain


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Film one unseen case: who drives how, what the policy takes them for, where it looks, what it does."""

    model: str
    """A shipped policy by its method's name (streaming, oracle, ...), always_go, ttc, the folder of a training run, a
    .safetensors file, or with --allow-pickle a .zip file."""
    out: Path
    """The film, .mp4 (needs tint_sumo[video]) or .gif, or a strip of eight moments, .png."""
    p_conservative: MixFlag | None = None
    """Probability that a driver is conservative, 0 to 1, or two numbers between which the case draws its own; those
    of the policy's training if not given."""
    case: Annotated[int, Range(0, 999_999)] = 0
    """Number of the case; the same cases as in policy evaluate."""
    seed: Seed = 0
    """Which set of cases, 0 to 1000."""
    scene: SceneValue = None
    """Scene; the one the policy was trained in if not given, for always_go and ttc t_intersection."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on the others' positions, m; the film shows where they are."""
    tau: TauS | None = None
    """Time headway of the other drivers, s; the scene's if not given, 1 s in all that are built in."""
    allow_pickle: bool = False
    """Read .zip files, which can run any code: only for files you trust."""

    def run(self) -> Outcome:
        from tint_sumo.films.film import render_case, require_film_file
        from tint_sumo.jobs.table import one_job
        from tint_sumo.methods.loading import load_policy

        require_film_file(self.out)
        use_one_thread()
        contender = load_policy(self.model, scene=self.scene, allow_pickle=self.allow_pickle)
        world = world_of(contender, self.p_conservative, self.noise, self.tau)
        with one_job(f"render {self.out}") as report:
            film = render_case(contender, self.case, self.out, seed=self.seed, report=report, **world)
        text = f"{film.outcome} after {film.time_s:.1f} s, {film.frames} frames: {self.out}"
        content = {
            "model": self.model,
            "scene": contender.scene_name,
            **plain(world),
            "case": self.case,
            "seed": self.seed,
        }
        return Outcome(text, {**content, "out": str(self.out), **asdict(film)})
