"""Remake what data/ ships: trait models, policies, their tables, pictures. Resumes where it was interrupted.

    .venv/bin/python scripts/make_shipped.py WORK_FOLDER
    .venv/bin/python scripts/make_shipped.py --pictures

Takes about four hours on two cores. With --pictures it takes a minute, and draws the pictures that follow from the
shipped policies and from the tables in data/results. The commands it runs are those of data/README.md.
"""

import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas
import torch
from matplotlib.figure import Figure
from measure_strangers import TRAINED_IN, read_table
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tint_sumo import ENV_IDS
from tint_sumo.cli import main as tint_sumo
from tint_sumo.comparisons.traits import TraitStudy
from tint_sumo.comparisons.traits_report import plot_noise
from tint_sumo.config import ALL_MIXES, POPULATIONS, SENSORS, Mix, Sensor, Traffic
from tint_sumo.core.files import write_json
from tint_sumo.core.statistics import Rate
from tint_sumo.core.weights import card_file, weights_file
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import Learned, find_method, needed_encoders
from tint_sumo.methods.training import POLICY
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.scenes import T_INTERSECTION, Scene, find_scene, paper_scene
from tint_sumo.scenes.drivers import DriverMember, members
from tint_sumo.scenes.geometry import clearance_m
from tint_sumo.simulation import SceneSimulation, Simulation
from tint_sumo.study.budgets import BUDGETS, Conditions
from tint_sumo.study.figures import plot_bars, plot_conditions, plot_worlds
from tint_sumo.study.jobs import label
from tint_sumo.study.results import GIVEN, TRAINED, read_results
from tint_sumo.study.results_csv import StoredRow, read_csv
from tint_sumo.study.summary import at_mixes, in_other_conditions, tabulate
from tint_sumo.traits.datasets import evaluate_traits
from tint_sumo.traits.storage import add_to_card

TITLE_PX = 26
CLEAR_M = 0.8
STREET = "t_intersection_street"
WAITING_STEPS = 400
DATA = Path(__file__).resolve().parents[1] / "data"
IMAGES = DATA / "images"
TRAINING_NOISE_M = {"cross_window": 0.05}  # of the shipped trait models that are trained with noise
AMONG_STRANGERS = ("ttc", "no_labels", "vae", "relative", "supervised", "oracle")  # methods in the figure


def run(*arguments: str) -> None:
    print("tint-sumo", *arguments, file=sys.stderr)
    if code := tint_sumo(arguments):
        sys.exit(code)


def make_traits(work: Path) -> None:
    """The comparison of trait methods: its tables, and one model of each method with its pictures."""
    study, dataset = work / "traits", str(work / "traits" / "dataset")
    run("traits", "study", "--out", str(study))
    for name in ("traits.csv", "traits.md", "traits_seeds.csv", "traits_continuous.csv"):
        copy(study / name, DATA / "results" / name)
    for method in needed_encoders():
        noise_m = TRAINING_NOISE_M.get(method, 0.0)
        model = DATA / "models" / f"{method}.safetensors"
        trained = study / "models" / f"{method}-noise{noise_m:g}-seed0"
        for suffix in (".safetensors", ".json"):
            copy(trained / f"model{suffix}", model.with_suffix(suffix))
        noises = TraitStudy().noises_m
        accuracy = {f"{noise:g}": evaluate_traits(Path(dataset), model, noise_m=noise)["accuracy"] for noise in noises}
        add_to_card(model, {"accuracy_by_noise": accuracy})  # in m; the linear classifier is fitted to each noise
        run("traits", "plot", "--data", dataset, "--model", str(model), "--noise", f"{noise_m}", "--out", str(work))
        copy(work / "latent.png", IMAGES / f"latent_{method}.png")
    run("traits", "plot", "--data", dataset, "--model", "vae", "--out", str(work))
    copy(work / "reconstruction.png", IMAGES / "reconstruction.png")


def make_scenes(work: Path) -> None:
    """Trait models in scenes they were not trained in."""
    study = work / "scenes"
    run("study", "scenes", "--out", str(study))
    for suffix in (".csv", ".md"):
        copy(study / f"scenes{suffix}", DATA / "results" / f"scenes{suffix}")


def make_policies(work: Path) -> None:
    """The navigation study: its tables, and the policy of each method with the first seed."""
    study = work / "navigation"
    run("study", "run", "--budget", "full", "--out", str(study))
    for suffix in (".csv", ".md"):
        copy(study / f"results{suffix}", DATA / "results" / f"navigation{suffix}")
    rows = [row.to_json() for row in at_mixes(tabulate(read_results(study)))]
    budget = BUDGETS["full"]
    for name in budget.methods:
        method = find_method(name)
        if isinstance(method, Learned):
            run_stem = study / "policies" / label(name, budget.mixes[0], budget.seeds[0]) / POLICY
            ship_policy(run_stem, method, [row for row in rows if row["method"] == name])


def ship_policy(run_stem: Path, method: Learned, rows: list[dict[str, Any]]) -> None:
    """Copy a policy; its card names the shipped trait model, and holds the method's results over all seeds."""
    shipped = DATA / "models" / "policies" / method.name
    copy(weights_file(run_stem), weights_file(shipped))
    shown = ("seeds", "episodes", "success", "timeout", "collision", "success_sd")
    results = {f"P {row['p_conservative']:g}": {key: row[key] for key in shown} for row in rows}
    write_json(card_file(shipped), {**read_policy_card(run_stem), "traits": method.encoder, "results": results})


def copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def make_figures(images: Path) -> None:
    """Draw the figures of the navigation study and of the comparison of trait methods, from their shipped tables."""
    rows, _ = read_csv(DATA / "results" / "navigation.csv")
    plot_bars(at_mixes(rows), images / "navigation.png")
    plot_conditions(in_other_conditions(rows), images / "conditions.png")
    plot_noise(pandas.read_csv(DATA / "results" / "traits.csv"), images / "traits.png")
    plot_worlds(rows_of_strangers(), images / "strangers.png")


def rows_of_strangers() -> list[StoredRow]:
    """Return rows of ``strangers.csv`` for the figure: a method's seeds in one, with intervals over all cases."""
    table = read_table(DATA / "results" / "strangers.csv")
    table = table[table["method"].isin(AMONG_STRANGERS)]
    table["is_trained"] = table["trained_in"] == TRAINED_IN
    rows = []
    for (is_trained, method, world), found in table.groupby(["is_trained", "method", "world"], sort=False):
        cases, seeds = int(found["cases"].iloc[0]), tuple(range(len(found)))
        counts = {outcome: found[f"{outcome}_percent"].sum() * cases / 100 for outcome in BUILT_IN_OUTCOMES}
        rates = {outcome: Rate(round(count), cases * len(seeds)) for outcome, count in counts.items()}
        rows.append(
            StoredRow(
                str(method),
                TRAINED if is_trained else GIVEN,
                ALL_MIXES if is_trained else None,
                Conditions(ALL_MIXES, world=str(world)),
                seeds,
                paper_scene().tau_s,
                cases,
                {outcome: rate.value for outcome, rate in rates.items()},
                {outcome: rate.interval for outcome, rate in rates.items()},
                dict.fromkeys(BUILT_IN_OUTCOMES),
                None,
            )
        )
    return rows


def make_pictures(images: Path) -> None:
    """Draw the paper's scene, all scenes of its scale side by side, each with its name, and the street."""
    pictures = {name: picture_of(name) for name in ENV_IDS if name != STREET}
    Image.fromarray(pictures[T_INTERSECTION]).save(images / "scene.png", optimize=True)
    sheet_of(pictures, 3).save(images / "scenes.png", optimize=True)
    Image.fromarray(picture_of(STREET)).save(images / "street.png", optimize=True)


def make_sensor_pictures(images: Path) -> None:
    """Draw the same moment as different sensors perceive it, each with its name."""
    wide = Sensor(range_m=15.0, field_of_view_deg=120.0)
    sensors = {"range_15": SENSORS["range_15"], "15 m, 120 degrees": wide}
    sensors |= {name: SENSORS[name] for name in ("occlusion", "corners")}
    sheet_of({name: perceived(sensor) for name, sensor in sensors.items()}, 2).save(
        images / "sensors.png", optimize=True
    )


def perceived(sensor: Sensor) -> NDArray[np.uint8]:
    """The street after two seconds in which the ego has crept forward."""
    env = SceneEnv(TaskSettings(sensor=sensor), render_mode="rgb_array")
    env.reset(seed=3)
    for _ in range(20):
        env.step(np.int64(1))
    picture = env.render()
    env.close()
    assert picture is not None
    return picture


def make_towns_picture(images: Path) -> None:
    """Draw the headways, desired speeds and entry gaps of both traits in each town, in the order of their headways."""
    drivers = members(replace(POPULATIONS["towns"], members=1))  # drivers of a trait differ in minimum gaps alone
    towns = sorted(zip(drivers[::2], drivers[1::2], strict=True), key=lambda pair: sum(one.idm.tau_s for one in pair))
    channels: dict[str, Callable[[DriverMember], float]] = {
        "time headway (s)": lambda driver: driver.idm.tau_s,
        "desired speed (m/s)": lambda driver: driver.desired_speed_mps,
        "mean gap at entry (m)": lambda driver: sum(driver.entry_gap_m) / 2,
    }
    figure = Figure(figsize=(9.0, 7.0), dpi=100, layout="constrained")
    for axes, (name, value) in zip(figure.subplots(3, 1, sharex=True), channels.items(), strict=True):
        levels = np.array([[value(driver) for driver in pair] for pair in towns])
        axes.vlines(range(len(towns)), *levels.T, color="0.8", linewidth=1.0)
        for column, profile in enumerate(POPULATIONS["towns"].profiles):
            axes.plot(levels[:, column], "o", color=profile.rgb, markersize=3.0, label=profile.name)
        axes.set_ylabel(name)
    figure.axes[0].legend(loc="upper left")
    figure.axes[-1].set_xlabel("towns, in the order of their headways")
    figure.savefig(images / "towns.png")


def make_willingness_picture(images: Path) -> None:
    """Draw for each driver of the lower lane when it would yield to an ego that waits, in several populations."""
    names = ("willing", "gentle", "inattentive", "polite")
    figure = Figure(figsize=(9.0, 7.0), dpi=100, layout="constrained")
    for axes, name in zip(figure.subplots(2, 2, sharex=True).flat, names, strict=True):
        scene = replace(find_scene(T_INTERSECTION), population=POPULATIONS[name], traffic=Traffic(Mix(0.7)))
        time_s, number, trait = traits_over_time(scene, seed=1)
        for index, profile in enumerate(scene.population.profiles):
            shown = trait == index
            axes.plot(time_s[shown], number[shown], "s", color=profile.rgb, markersize=2.0)
        axes.set_title(name)
    figure.supxlabel("time (s)")
    figure.supylabel("driver of the lower lane, in order of appearance")
    figure.savefig(images / "willingness.png")


def traits_over_time(scene: Scene, seed: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return for each step of each driver on the lower lane time, running number and present trait; an ego waits."""
    simulation = SceneSimulation(1, scene)
    simulation.reset(0, seed)
    rows = []
    for _ in range(WAITING_STEPS):
        slots, traits = simulation.slots, simulation.traits()[0]
        for slot in np.flatnonzero(slots.present[0] & (slots.route[0] == 0)).tolist():
            rows.append((simulation.time_s[0], slots.vehicle_number[0, slot], traits[slot]))
        simulation.step(np.zeros(1))
    simulation.close()
    time_s, number, trait = np.array(rows).T
    return time_s, np.unique(number, return_inverse=True)[1], trait


def sheet_of(pictures: Mapping[str, NDArray[np.uint8]], columns: int) -> Image.Image:
    """All pictures in rows, each below its name."""
    titled = [titled_picture(name, picture) for name, picture in pictures.items()]
    rows = [titled[first : first + columns] for first in range(0, len(titled), columns)]
    width, heights = titled[0].width + 8, [max(picture.height for picture in row) + 8 for row in rows]
    sheet = Image.new("RGB", (columns * width, sum(heights)), "white")
    for number, row in enumerate(rows):
        for column, picture in enumerate(row):
            sheet.paste(picture, (column * width, sum(heights[:number])))
    return sheet


def titled_picture(name: str, picture: NDArray[np.uint8]) -> Image.Image:
    """Half as large, below the name of the scene."""
    small = Image.fromarray(picture).reduce(2)
    titled = Image.new("RGB", (small.width, small.height + TITLE_PX), "white")
    ImageDraw.Draw(titled).text((2, 3), name, fill="black", font=ImageFont.load_default(17))
    titled.paste(small, (0, TITLE_PX))
    return titled


def picture_of(scene: str) -> NDArray[np.uint8]:
    """The middle of the moments in which an ego, on its way to success, is in the traffic and clear of all vehicles."""
    env = gymnasium.make(ENV_IDS[scene], render_mode="rgb_array")
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, SceneEnv)
    shown: list[NDArray[np.uint8]] = []
    outcome = ""
    for seed in range(100):
        env.reset(seed=seed)
        shown, outcome = [], ""
        while not outcome:
            *_, info = env.step(np.int64(2))
            outcome = info["outcome"]
            if is_clear_in_traffic(unwrapped.simulation):
                picture = env.render()
                assert isinstance(picture, np.ndarray)
                shown.append(picture)
        if outcome == "success" and shown:
            break
    else:
        sys.exit(f"no ego that always goes crosses {scene}")
    env.close()
    return shown[len(shown) // 2]


def is_clear_in_traffic(simulation: Simulation) -> bool:
    """Return whether the ego claims a lane and all vehicles are as far from it as its safety check asks, or farther."""
    assert isinstance(simulation, SceneSimulation)
    slots, ego = simulation.slots, simulation.egos.box[0]
    clear = all(clearance_m(ego, box) >= CLEAR_M for box in slots.box[0, slots.present[0]])
    return clear and bool(simulation.yielding.has_claimed[0].any())


def make_films() -> None:
    """A case that a shipped policy drives, as a film and as a strip."""
    for name in ("case.gif", "strip.png"):
        film = str(IMAGES / name)
        run("render", "--model", "cross_window", "--p-conservative", "0.4", "--case", "1", "--out", film)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    torch.set_num_threads(1)  # the networks are small
    if sys.argv[1] == "--pictures":
        make_figures(IMAGES)
        make_pictures(IMAGES)
        make_sensor_pictures(IMAGES)
        make_towns_picture(IMAGES)
        make_willingness_picture(IMAGES)
        make_films()
        sys.exit()
    make_pictures(IMAGES)
    make_sensor_pictures(IMAGES)
    make_towns_picture(IMAGES)
    make_willingness_picture(IMAGES)
    make_traits(Path(sys.argv[1]))
    make_policies(Path(sys.argv[1]))
    make_figures(IMAGES)
    make_films()
    make_scenes(Path(sys.argv[1]))
