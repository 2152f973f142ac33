"""Measure where the CPU time of a training goes; writes a table.

Usage: python scripts/profile_training.py [--out data/results/training_profile.csv]

Python's profiler counts CPU time, so other work on the machine changes the shares little. It makes calls slower, many
short ones more than few long ones; the time per decision is therefore measured without it.
"""

import argparse
import cProfile
import pstats
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pandas

from tint_sumo.config import ALL_MIXES, PPO_BUDGETS
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_frame
from tint_sumo.envs.worlds import find_world, scene_in
from tint_sumo.methods.registry import find_learned
from tint_sumo.methods.training import new_model, training_venv
from tint_sumo.scenes import paper_scene

WARM_UP, MEASURED = 24_576, 32_768  # decisions at least: three and four of the longest rollouts
Calls = tuple[str, str]  # end of the file's path and name of a function


@dataclass(frozen=True)
class Part:
    """Part of a training: the time in some functions, less that in functions that they call and other parts have."""

    name: str
    functions: tuple[Calls, ...]
    without: tuple[Calls, ...] = ()


SUMO = ("", "simulation_step>")
SIMULATION = (("simulation/scene.py", "step"), ("envs/episodes.py", "begin"))
ENVIRONMENT, WRAPPED = ("envs/sb3.py", "step_wait"), ("vec_env/base_vec_env.py", "step")
ROLLOUT, UPDATE = ("policy/ppo.py", "collect_rollouts"), ("policy/ppo.py", "train")
PARTS = (
    Part("SUMO's step", (SUMO,)),
    Part("rest of the simulation", SIMULATION, (SUMO,)),
    Part("sensor, observation and reward", (ENVIRONMENT,), SIMULATION),
    Part("traits and motion", (WRAPPED,), (ENVIRONMENT,)),
    Part("the policy's actions", (ROLLOUT,), (WRAPPED,)),
    Part("update", (UPDATE,)),
)
TRAININGS = (  # method, world and budget
    ("no_labels", "old", "full"),
    ("relative", "strangers", "strangers"),
    ("no_labels", "old", "paper"),
)


def cpu_s(stats: pstats.Stats, functions: tuple[Calls, ...]) -> float:
    """Return the CPU time in some functions and in all that they call."""
    found = 0.0
    for (file, _, name), (_, _, _, cumulative_s, _) in stats.stats.items():  # type: ignore[attr-defined]
        if any(file.endswith(path) and name.endswith(function) for path, function in functions):
            found += cumulative_s
    return found


def profile(method: str, world: str, budget: str) -> list[dict[str, object]]:
    """Return the rows of a training: the CPU time per decision of each part."""
    learned, place = find_learned(method), find_world(world)
    settings = learned.settings_of(PPO_BUDGETS[budget])
    scenes = [scene_in(place, paper_scene())]
    with (
        single_threaded(),
        closing(training_venv(learned, None, ALL_MIXES, settings, scenes, place.sensors)) as venv,
    ):
        decisions = settings.whole_rollouts(MEASURED)
        model = new_model(venv, 0, settings).learn(settings.whole_rollouts(WARM_UP))
        start_s = time.process_time()
        model.learn(decisions, reset_num_timesteps=False)
        whole_us = 1e6 * (time.process_time() - start_s) / decisions
        profiler = cProfile.Profile(time.process_time)
        profiler.runcall(model.learn, decisions, reset_num_timesteps=False)
    stats = pstats.Stats(profiler)
    times_s = {part.name: cpu_s(stats, part.functions) - cpu_s(stats, part.without) for part in PARTS}
    return [
        {
            "method": method,
            "world": world,
            "budget": budget,
            "part": name,
            "share_percent": round(100 * part_s / sum(times_s.values()), 1),
            "cpu_us_per_decision": round(whole_us * part_s / sum(times_s.values()), 1),
        }
        for name, part_s in times_s.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("data/results/training_profile.csv"))
    out = parser.parse_args().out
    table = pandas.DataFrame([row for training in TRAININGS for row in profile(*training)])
    write_frame(table, out)
    print(table.to_string(index=False), f"wrote {out}", sep="\n")


if __name__ == "__main__":
    main()
