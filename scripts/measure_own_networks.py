"""Train a policy in each of three SUMO configurations, and compare it with the rules and SUMO's driver on unseen cases.

Writes ``own_networks.csv`` into data/results: python scripts/measure_own_networks.py WORK_FOLDER [NETWORK ...]

The folder keeps the trainings, which go on where they were interrupted, and a made network. Rows of networks that are
not named stay as they are.
"""

import argparse
import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import sumo

from tint_sumo.bench.networks import grid_config
from tint_sumo.config import EgoController, PpoSettings, network_ppo
from tint_sumo.core.files import write_text
from tint_sumo.core.progress import Progress
from tint_sumo.methods.evaluation import REPORTED_SET, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.training import train_policy
from tint_sumo.scenes import SumocfgScene, from_sumocfg

RESULTS = Path(__file__).parents[1] / "data" / "results" / "own_networks.csv"
SHIPPED = Path(sumo.SUMO_HOME) / "tools" / "game"
CASES = 200
RULES = ("always_go", "ttc", "sumo")
OUTCOMES = ("success", "timeout", "collision", "red_light", "lost")
# A single environment needs no other process: on busy cores, processes wait for each other.
_ALONE: dict[str, Any] = {"n_envs": 1, "n_steps": 256, "n_minibatches": 1, "n_epochs": 8, "learning_rate": 2e-3}
_REPORT_EVERY = 5000  # decisions


@dataclass(frozen=True)
class Network:
    """A task, and the training in it."""

    scene: SumocfgScene
    ppo: PpoSettings
    decisions: int


def motorway(_: Path) -> Network:
    """Return the A10 that SUMO ships: the ego joins it from a ramp whose lane ends."""
    scene = from_sumocfg(
        SHIPPED / "A10KW.sumocfg",
        ["308396220", "264308374", "399250313"],
        20.0,
        400.0,
        controller=EgoController((0.0, 10.0, 20.0)),
        warm_up_s=60.0,
        warm_starts=24,
        time_limit_s=60.0,
    )
    ppo = replace(network_ppo(scene.step_s), n_envs=4, n_minibatches=2, learning_rate=2e-3)
    return Network(scene, ppo, 40_000)


def braunschweig(_: Path) -> Network:
    """Return the streets of Braunschweig that SUMO ships: the ego crosses a junction with lights, and sees them."""
    scene = from_sumocfg(
        SHIPPED / "fokr_bs_demo.sumocfg",
        ["-3", "-3.22", "2"],
        23.8,
        132.0,
        warm_up_s=60.0,
        warm_up_spread_s=120.0,
        warm_starts=24,
        time_limit_s=120.0,
        perceives=("traffic_light",),
        red_light="end",
    )
    return Network(scene, _slow_decisions(scene), 32_000)


def grid(folder: Path) -> Network:
    """Return 4 by 4 crossings with lights, which the ego sees; it goes straight on, turns right, and is there."""
    scene = from_sumocfg(
        grid_config(folder, 0.08),
        ["bottom1B0", "B0B1", "B1C1"],
        20.0,
        330.0,
        warm_up_s=60.0,
        warm_up_spread_s=90.0,
        warm_starts=24,
        time_limit_s=120.0,
        perceives=("traffic_light",),
        red_light="end",
    )
    return Network(scene, _slow_decisions(scene), 32_000)


def _slow_decisions(scene: SumocfgScene) -> PpoSettings:
    """Return settings with decisions every 0.8 s: the ego waits for lights for long."""
    usual = network_ppo(scene.step_s)
    return replace(usual, **_ALONE, action_repeat=2 * usual.action_repeat)


NETWORKS = {make.__name__: make for make in (motorway, braunschweig, grid)}


def rows_of(name: str, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield a row for each rule, and one for the policy that has been trained."""
    folder.mkdir(parents=True, exist_ok=True)
    network = NETWORKS[name](folder)
    for rule in RULES:
        yield {"network": name, "method": rule, "decisions": "", **_rates(rule, network.scene)}
    out = folder / "policy"
    report = _Report(name)
    train_policy(
        "no_labels", None, network.decisions, 0, out, settings=network.ppo, scene=network.scene, report=report.show
    )
    yield {"network": name, "method": "no_labels", "decisions": network.decisions, **_rates(out, network.scene)}


class _Report:
    """Prints a training's progress now and then."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._next = 0

    def show(self, progress: Progress) -> None:
        if progress.done >= self._next:
            shares = ", ".join(f"{outcome} {100 * share:.1f} %" for outcome, share in progress.measures.items())
            print(f"{self._name}: {progress.done} of {progress.total} decisions, {shares}", flush=True)
            self._next = progress.done + _REPORT_EVERY


def _rates(model: str | Path, scene: SumocfgScene) -> dict[str, str]:
    contender = load_policy(model, scene=scene)
    found = evaluate(contender.policy, lambda count: contender.make_venv(count, contender.task), CASES, REPORTED_SET)
    time_s = found.navigation_time_s
    shares = {f"{outcome}_percent": f"{100 * found.rate(outcome).value:.1f}" for outcome in OUTCOMES}
    return {**shares, "time_s": "" if time_s is None else f"{time_s:.1f}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("networks", nargs="*", default=list(NETWORKS), choices=list(NETWORKS))
    given = parser.parse_args()
    rows = list(csv.DictReader(RESULTS.open(encoding="utf-8"))) if RESULTS.exists() else []
    for name in given.networks:
        rows = [row for row in rows if row["network"] != name]
        for row in rows_of(name, given.folder / name):
            print(*row.values(), sep=" | ", flush=True)
            rows.append({key: str(value) for key, value in row.items()})
        text = io.StringIO()
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: list(NETWORKS).index(row["network"])))
        write_text(RESULTS, text.getvalue())


if __name__ == "__main__":
    main()
