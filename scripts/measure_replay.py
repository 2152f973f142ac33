"""Measure what reacting vehicles are worth in recordings: nobody reacts, one driver for all, or drivers as fitted.

In recordings of the street of the T-intersection the truth is known: the same traffic is simulated once without the
ego, which is the recording, and once with it, which is the truth. Drivers differ in headway, gap, acceleration and
braking, which are hidden from the fits, and half of them yield. In CommonRoad scenes all that is known is what happened
behind the vehicle that the ego takes over from: there one ego drives as that vehicle did.

Prints how fast the environments are, and writes ``replay.csv`` into data/results:
python scripts/measure_replay.py FOLDER_OF_COMMONROAD_SCENES
"""

import csv
import io
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from tint_sumo.config import EgoControl, FittedDriver, Mix, Population
from tint_sumo.core.files import write_text
from tint_sumo.drivers.fitted import Fitted, fit_drivers
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.pairs import find_pairs
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.maps import import_map
from tint_sumo.methods.rules import GO, STOP, Observation, TimeToCollision, threshold_s
from tint_sumo.replay import EgoOnEdges, from_tracks
from tint_sumo.scenes import Scene, find_scene
from tint_sumo.scenes.build import NET_FILE, scene_files
from tint_sumo.scenes.drivers import DriverMember
from tint_sumo.scenes.geometry import Floats
from tint_sumo.scenes.network import name
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.simulation import ReplaySimulation, SceneSimulation, Simulation, make_simulation
from tint_sumo.tracks import Tracks, read_tracks
from tint_sumo.tracks.schema import build_tracks

RESULTS = Path(__file__).parents[1] / "data" / "results" / "replay.csv"
SEEDS = range(4)
HIDDEN = 48  # drivers, whose headway (s), minimum gap (m), acceleration and braking (m/s2) are hidden from fits:
MEDIANS, SPREADS = (1.2, 2.0, 1.8, 2.5), (0.35, 0.3, 0.3, 0.3)  # log-normal
RECORDED_S = 60.0
STARTS_S = tuple(range(5, 46, 5))
LONGEST_S = 12.0  # of an ego's drive
LEAST_PAIR_S = 3.0
REACTED_M = 2.0  # a vehicle that is so far from where it was recorded has reacted
# The agents of nuPlan's closed loop, idm_agents_observation.yaml in motional/nuplan-devkit; those of MetaDrive and
# Waymax have other constants, and are alike for everybody, too.
ONE_FOR_ALL = FittedDriver(tau_s=1.5, min_gap_m=1.0, accel_mps2=1.0, decel_mps2=2.0)
TURNS, EPISODES, EPISODE_STEPS = 5, 10, 100  # of the comparison of speeds
OUTCOMES = ("success", "timeout", "collision")
Positions = dict[tuple[str, int], float]  # x of a vehicle's centre by its name and step


@dataclass(frozen=True)
class Drive:
    """Outcome of an ego's drive, its length, and where the others were."""

    outcome: str
    steps: int
    x_m: Positions


def street() -> Scene:
    """Return the street with drivers who differ."""
    rng = np.random.default_rng(7)
    drawn = np.exp(rng.normal(np.log(MEDIANS), SPREADS, (HIDDEN, len(MEDIANS))))
    drivers = tuple(FittedDriver(*(round(value, 3) for value in one)) for one in drawn.tolist())
    scene = find_scene("t_intersection_street")
    base = scene.population
    population = Population(base.profiles, members=24, seed=base.seed, idm=base.idm, fitted=drivers)
    return replace(scene, population=population, traffic=replace(scene.traffic, p_conservative=Mix(0.5)))


# Egos: functions of what the rules of built-in scenes observe, and the number of the step since the ego's start


class Ego:
    """An ego that drives by a rule, the same in recordings as in the scene."""

    def __init__(self, rule: str, scene: Scene) -> None:
        self._rule = rule
        self._ttc = TimeToCollision(threshold_s(scene), scene=scene)
        self._state: tuple[Floats, ...] | None = None

    def action(self, simulation: Simulation, scene: Scene, step: int) -> int:
        if self._rule == "always go":
            return GO
        if self._rule == "stops in the lane":
            return GO if step < 15 else STOP if step < 60 else GO
        actions, self._state = self._ttc.predict(observed(simulation, scene), self._state)
        return int(actions[0])


EGOS = ("always go", "stops in the lane", "ttc")


def observed(simulation: Simulation, scene: Scene) -> Observation:
    """Return what rules observe, in the scene's frame and units."""
    ego, slots = simulation.egos.box, simulation.slots
    left_m, low_m = simulation.origin_m
    own = np.array([[ego["x_m"][0] + left_m, ego["y_m"][0] + low_m, 0.0, 0.0]])
    others = np.stack([slots.box["x_m"] - ego["x_m"][:, None], slots.box["y_m"] - ego["y_m"][:, None]], axis=-1)
    return {
        "ego": (own / scene.position_scale_m).astype(np.float32),
        "vehicles": (others * slots.present[..., None] / scene.position_scale_m).astype(np.float32),
        "mask": slots.present.astype(np.float32),
    }


def drive(simulation: Simulation, scene: Scene, ego: Ego, goal_m: float, first_step: int) -> Drive:
    """Let an ego drive in a simulation whose step is ``first_step`` of the recording now."""
    speeds_mps = scene.ego.controller.desired_speeds_mps
    x_m: Positions = {}
    for step in range(round(LONGEST_S / scene.step_s)):
        x_m |= positions(simulation, first_step + step)
        simulation.step(np.array([speeds_mps[ego.action(simulation, scene, step)]]))
        if simulation.egos.collided[0]:
            return Drive("collision", step, x_m)
        if simulation.egos.front_m[0] > goal_m:
            return Drive("success", step, x_m)
    return Drive("timeout", step, x_m)


def positions(simulation: Simulation, step: int) -> Positions:
    slots, left_m = simulation.slots, simulation.origin_m[0]
    if isinstance(simulation, ReplaySimulation):
        names = simulation.scene.recording.vehicles
        taken = {names[int(known)]: slot for known, slot in simulation.slot.items()}
    else:
        taken = {str(slots.vehicle_number[0, slot]): slot for slot in np.flatnonzero(slots.present[0]).tolist()}
    return {(vehicle, step): float(slots.box["x_m"][0, slot]) + left_m for vehicle, slot in taken.items()}


@dataclass(frozen=True)
class Recorded:
    """A recording of the street, and what is hidden of its drivers."""

    seed: int
    tracks: Tracks
    members: Mapping[str, DriverMember]  # by the names of vehicles


def record(scene: Scene, seed: int) -> Recorded:
    """Record the street without the ego."""
    rows, members = [], {}
    with closing(SceneSimulation(1, scene, with_ego=False)) as simulation:
        simulation.reset(0, seed)
        for step in range(round(RECORDED_S / scene.step_s) + 1):
            if step:
                simulation.step()
            slots = simulation.slots
            for slot in np.flatnonzero(slots.present[0]).tolist():
                box, vehicle = slots.box[0, slot], str(slots.vehicle_number[0, slot])
                members[vehicle] = simulation.population[slots.member[0, slot]]
                heading_rad = np.arctan2(box["heading_y"], box["heading_x"])
                pose = (step * scene.step_s, box["x_m"], box["y_m"], heading_rad, simulation.link.speed_mps(0, slot))
                rows.append((vehicle, *pose, box["length_m"], box["width_m"]))
    names = ["vehicle", "time_s", "x_m", "y_m", "heading_rad", "speed_mps", "length_m", "width_m"]
    columns = {"recording": f"street{seed}", **pd.DataFrame(rows, columns=names), "vehicle_class": "car"}
    return Recorded(seed, build_tracks(Path(f"street{seed}.csv"), "recorded", columns), members)


def truths(scene: Scene, recorded: Recorded) -> dict[tuple[str, int], Drive]:
    """Return the true drives of each ego from each start, in the same traffic as was recorded."""
    found = {}
    with closing(SceneSimulation(1, scene)) as simulation:
        for ego in EGOS:
            for start_s in STARTS_S:
                simulation.reset(0, recorded.seed)
                for _ in range(round(start_s / scene.step_s)):
                    simulation.step(np.zeros(1))
                first = round(start_s / scene.step_s)
                found[ego, start_s] = drive(simulation, scene, Ego(ego, scene), scene.ego.goal_m, first)
    return found


def fit(recorded: Recorded, folder: Path) -> Fitted:
    pairs = find_pairs(recorded.tracks, min_duration_s=LEAST_PAIR_S).pairs
    return fit_drivers(pairs, MODELS["IDM"], folder / f"fit{recorded.seed}")


def inferred(scene: ReplayScene, fitted: Fitted) -> dict[str, bool]:
    """Return who yields, by two clusters of the drivers' recorded speeds and fitted gaps: the slower ones do."""
    (recording,) = scene.recordings
    gap = [parameter.name for parameter in fitted.car_following.parameters].index("min_gap_m")
    fits = {fit.name.partition("/")[2]: fit.fit.log_parameters[gap] for fit in fitted.drivers}
    usual = fitted.population.mean.log_parameters[gap]
    features = np.array(
        [
            (np.log(_fast_mps(recording.speed_mps[first : first + rows])), fits.get(vehicle, usual))
            for vehicle, first, rows in zip(recording.vehicles, recording.first_row, recording.rows, strict=True)
        ]
    )
    features = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-9)
    centres = features[[np.argmin(features[:, 0]), np.argmax(features[:, 0])]]
    for _ in range(50):
        nearest = np.argmin(np.linalg.norm(features[:, None] - centres[None], axis=-1), axis=1)
        centres = np.array([features[nearest == cluster].mean(axis=0) for cluster in range(2)])
    return {vehicle: cluster == 0 for vehicle, cluster in zip(recording.vehicles, nearest.tolist(), strict=True)}


def _fast_mps(speed_mps: Floats) -> float:
    return max(float(np.quantile(speed_mps, 0.9)), 0.1)


def ego_of(scene: Scene) -> EgoOnEdges:
    edges = tuple(name(edge, 0) for edge in scene.ego.edges)
    return EgoOnEdges(edges, scene.ego.start_m, scene.ego.goal_m, every_s=5.0)


def scenes(scene: Scene, recorded: Recorded, net: Path, folder: Path) -> Iterator[tuple[str, ReplayScene]]:
    """Yield names of kinds of drivers, and the recording's scenes with them."""
    ego = ego_of(scene)
    fitted = fit(recorded, folder)
    labels = {vehicle: member.profile.yields for vehicle, member in recorded.members.items()}

    def made(
        drivers: Fitted | FittedDriver | None, yields: Mapping[str, bool] | None, reactive: bool = True
    ) -> ReplayScene:
        controller = scene.ego.controller
        return from_tracks(
            net,
            recorded.tracks,
            ego,
            reactive=reactive,
            drivers=drivers,
            yields=yields,
            controller=controller,
            max_vehicles=scene.max_vehicles,
            sight_m=300.0,
        )

    yield "nobody reacts", made(None, None, reactive=False)
    yield "SUMO's default", made(None, None)
    yield "one IDM for all", made(ONE_FOR_ALL, None)
    yield "fitted", made(fitted, None)
    replayed = made(fitted, None)
    guessed = inferred(replayed, fitted)
    right = np.mean([guessed[vehicle] == yields for vehicle, yields in labels.items() if vehicle in guessed])
    print(f"recording {recorded.seed}: {len(fitted.drivers)} of {len(labels)} fitted, {right:.0%} of traits right")
    yield "fitted, traits inferred", made(fitted, guessed)
    yield "fitted, traits known", made(fitted, labels)
    yield "true parameters, traits known", true_scene(made(ONE_FOR_ALL, labels), recorded)


def true_scene(scene: ReplayScene, recorded: Recorded) -> ReplayScene:
    """Return a scene whose drivers have the hidden parameters."""
    (recording,) = scene.recordings
    attributes = tuple(_true(recorded.members[vehicle]) for vehicle in recording.vehicles)
    return replace(scene, recordings=(replace(recording, attributes=attributes),))


def _true(member: DriverMember) -> dict[str, float]:
    idm = member.idm
    return {
        "tau": idm.tau_s,
        "minGap": member.min_gap_m,
        "accel": idm.accel_mps2,
        "decel": idm.decel_mps2,
        "emergencyDecel": idm.emergency_decel_mps2,
        "maxSpeed": member.desired_speed_mps,
    }


@dataclass(frozen=True)
class Compared:
    """A drive in a recording, beside the true one."""

    same_outcome: bool
    errors_m: tuple[float, ...]  # of each vehicle, mean over time
    reacts_in_both: int
    reacts_in_one: int  # or in both


def compare(true: Drive, found: Drive, recorded_x_m: Positions, first_step: int) -> Compared:
    """Compare where vehicles are, as long as both drives last."""
    last = first_step + min(true.steps, found.steps)
    errors_m, reacting = [], []
    for vehicle in sorted({vehicle for vehicle, _ in true.x_m}):
        steps = [step for step in range(first_step, last) if (vehicle, step) in recorded_x_m]
        known = [step for step in steps if (vehicle, step) in true.x_m and (vehicle, step) in found.x_m]
        if known:
            recorded, real, shown = (
                np.array([drive[vehicle, step] for step in known]) for drive in (recorded_x_m, true.x_m, found.x_m)
            )
            errors_m.append(float(np.abs(real - shown).mean()))
            reacting.append([np.abs(x_m - recorded).max() > REACTED_M for x_m in (real, shown)])
    both, one = (sum(bool(count(pair)) for pair in reacting) for count in (all, any))
    return Compared(true.outcome == found.outcome, tuple(errors_m), both, one)


def measure_street(folder: Path) -> Iterator[dict[str, object]]:
    """Yield a row for each kind of drivers and ego."""
    scene = street()
    net = folder / NET_FILE
    net.write_text(scene_files(scene, 1)[NET_FILE], encoding="utf-8")
    drives: dict[tuple[str, str], list[tuple[str, str, Compared]]] = {}
    for seed in SEEDS:
        recorded = record(scene, seed)
        true = truths(scene, recorded)
        table = recorded.tracks.table
        steps = (table["time_s"] / scene.step_s).round().astype(int)
        recorded_x_m: Positions = dict(zip(zip(table["vehicle"], steps, strict=True), table["x_m"], strict=True))
        for kind, replayed in scenes(scene, recorded, net, folder):
            with closing(make_simulation(1, replayed)) as simulation:
                for case, at in enumerate(replayed.cases):
                    start_s = round(at.step * scene.step_s)
                    for ego in EGOS if start_s in STARTS_S else ():
                        simulation.reset(0, case)
                        found = drive(simulation, scene, Ego(ego, scene), scene.ego.goal_m, at.step)
                        compared = compare(true[ego, start_s], found, recorded_x_m, at.step)
                        drives.setdefault((ego, kind), []).append((found.outcome, true[ego, start_s].outcome, compared))
    for (ego, kind), outcomes in drives.items():
        yield row_of("street, recorded here", ego, kind, outcomes)


def measure_speed(folder: Path) -> None:
    """Print steps per second of an environment of the street, and of its recording with as many vehicles, in turns."""
    scene = street()
    recorded, net = record(scene, 0), folder / NET_FILE
    net.write_text(scene_files(scene, 1)[NET_FILE], encoding="utf-8")
    kinds: dict[str, Scene | ReplayScene] = {"scene": scene}
    for kind, reactive in (("nobody reacts", False), ("reactive", True)):
        kinds[kind] = from_tracks(
            net, recorded.tracks, ego_of(scene), reactive=reactive, max_vehicles=scene.max_vehicles, sight_m=300.0
        )
    speeds: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(TURNS):
        for kind, played in kinds.items():
            speeds[kind].append(steps_per_s(SceneEnv(TaskSettings(played))))
    first = np.array(speeds["scene"])
    for kind, found in speeds.items():
        print(f"{kind}: {np.median(found):,.0f} steps/s, {np.median(np.array(found) / first):.2f} times the scene's")


def steps_per_s(env: SceneEnv) -> float:
    """Return the steps in a second of an ego that stands, without resets."""
    taken_s, steps = 0.0, 0
    with closing(env):
        for seed in range(EPISODES):
            env.reset(seed=seed)
            begin_s = time.perf_counter()
            for _ in range(EPISODE_STEPS):
                env.step(np.int64(STOP))
            taken_s += time.perf_counter() - begin_s
            steps += EPISODE_STEPS
    return steps / taken_s


def row_of(recording: str, ego: str, kind: str, found: Sequence[tuple[str, str, Compared]]) -> dict[str, object]:
    outcomes, true, compared = zip(*found, strict=True)
    errors_m = [error for one in compared for error in one.errors_m]
    both, one = sum(one.reacts_in_both for one in compared), sum(one.reacts_in_one for one in compared)
    return {
        "recording": recording,
        "ego": ego,
        "others": kind,
        "cases": len(found),
        **rates(outcomes),
        **rates(true, "true_"),
        "same_outcome_percent": round(100.0 * float(np.mean([one.same_outcome for one in compared])), 1),
        "position_error_m": mean_m(errors_m),
        "same_who_react_percent": round(100.0 * both / one, 1) if one else "",
        "released_error_m": "",
    }


# CommonRoad


AS_RECORDED, SUMO = "as recorded", "SUMO's own"
ACTIONS = {"always go": 2, "half of the speed limit": 1, "stops": 0}


def measure_commonroad(file: Path, folder: Path) -> Iterator[dict[str, object]]:
    """Yield a row for each kind of drivers and ego in a scene."""
    net, tracks = import_map(file, folder / file.stem).net, read_tracks(file)
    fitted = fit_drivers(find_pairs(tracks).pairs, MODELS["IDM"], folder / f"{file.stem}.fit")
    print(f"{file.stem}: {len(fitted.drivers)} fitted")
    kinds: dict[str, Fitted | FittedDriver | None] = {
        "nobody reacts": None,
        "SUMO's default": None,
        "one IDM for all": ONE_FOR_ALL,
        "fitted": fitted,
    }
    for kind, drivers in kinds.items():
        for ego in (AS_RECORDED, *ACTIONS, SUMO):
            control: EgoControl = "sumo" if ego == SUMO else "speed"
            reactive = kind != "nobody reacts"
            scene = from_tracks(net, tracks, drivers=drivers, reactive=reactive, ego_control=control)
            with closing(ReplaySimulation(1, scene)) as simulation:
                found = [among_recorded(simulation, case, ego) for case in range(len(scene.cases))]
            errors_m = [error for _, errors in found for error in errors]
            yield {
                "recording": file.stem,
                "ego": ego,
                "others": kind,
                "cases": len(found),
                **rates([outcome for outcome, _ in found]),
                "released_error_m": mean_m(errors_m) if ego == AS_RECORDED else "",
            }


def among_recorded(simulation: ReplaySimulation, case: int, ego: str) -> tuple[str, list[float]]:
    """Return the outcome of a drive, and how far each vehicle that reacts is from where it was recorded, m."""
    simulation.reset(0, case)
    scene, egos = simulation.scene, simulation.egos
    recorded_mps = recorded_speeds_mps(scene)
    off_m: dict[str, list[float]] = {}
    for step in range(1, round(scene.time_limit_s / scene.step_s) + 1):
        wanted_mps = scene.controller.desired_speeds_mps[ACTIONS.get(ego, 2)]
        if ego == AS_RECORDED and step < len(recorded_mps):
            now_mps = float(egos.speed_mps[0])
            wanted_mps = now_mps + (recorded_mps[step] - now_mps) / scene.step_s / egos.rules.gain_per_s
        simulation.step(np.array([wanted_mps]))
        if egos.collided[0]:
            return "collision", means_m(off_m)
        if egos.front_m[0] > scene.goal_m:
            return "success", means_m(off_m)
        for known, slot in simulation.slot.items():
            away_m = from_recorded_m(simulation, int(known), slot, scene.cases[scene.case].step + step)
            if away_m is not None:
                off_m.setdefault(known, []).append(away_m)
    return "timeout", means_m(off_m)


def recorded_speeds_mps(scene: ReplayScene) -> Floats:
    """Return the recorded speeds of the vehicle that the ego takes over, from the ego's start on."""
    case, recording = scene.cases[scene.case], scene.recording
    first, rows = int(recording.first_row[case.track]), int(recording.rows[case.track])
    return recording.speed_mps[first : first + rows][case.step - int(recording.first_step[case.track]) :]


def from_recorded_m(simulation: ReplaySimulation, track: int, slot: int, step: int) -> float | None:
    """Return how far a vehicle is from where it was recorded; None if it is there, or was not recorded then."""
    recording, at = simulation.scene.recording, simulation.slots.box[0, slot]
    row = step - int(recording.first_step[track])
    if simulation.is_replayed(slot) or row >= recording.rows[track]:
        return None
    box, (left_m, low_m) = recording.box[recording.first_row[track] + row], simulation.origin_m
    return float(np.hypot(box["x_m"] - at["x_m"] - left_m, box["y_m"] - at["y_m"] - low_m))


def means_m(off_m: Mapping[str, list[float]]) -> list[float]:
    return [float(np.mean(away_m)) for away_m in off_m.values()]


def mean_m(values: Sequence[float]) -> float | str:
    return round(float(np.mean(values)), 2) if values else ""


def rates(outcomes: Sequence[str], before: str = "") -> dict[str, float]:
    """Return the share of each outcome, in percent."""
    return {f"{before}{word}_percent": round(100.0 * outcomes.count(word) / len(outcomes), 1) for word in OUTCOMES}


def main() -> None:
    files = sorted(Path(sys.argv[1]).glob("*.xml"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure_speed(folder)
        rows = [*measure_street(folder), *(row for file in files for row in measure_commonroad(file, folder))]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(RESULTS, text.getvalue())


if __name__ == "__main__":
    main()
