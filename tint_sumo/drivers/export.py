"""Fitted drivers for others: vTypes that plain SUMO draws from, a population for our scenes, and a picture."""

from dataclasses import fields
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from scipy.stats import norm

from tint_sumo.config import FittedDriver, Idm
from tint_sumo.core.files import require_output_folder, require_own_files, whole_file, write_text
from tint_sumo.core.structures import plain
from tint_sumo.core.yaml_files import to_yaml
from tint_sumo.drivers.fitted import Fitted
from tint_sumo.drivers.models import CarFollowing, Floats, Parameter
from tint_sumo.drivers.population import draws
from tint_sumo.drivers.replay import vtype_xml

DISTRIBUTION_ID = "drivers"
VTYPES_FILE, POPULATION_FILE, PICTURE_FILE = "drivers.add.xml", "population.yaml", "drivers.png"
_VTYPES_NOTE, _POPULATION_NOTE = "Fitted with a step length", "Drivers that were fitted to a recording"
_RECORDED, _DEFAULT = "#2a6f97", "#c1121f"  # colours
_OUTER = 0.001  # quantiles between which densities are drawn


def export(fitted: Fitted, out: Path, size: int, seed: int, speed_limit_mps: float | None = None) -> list[Path]:
    """Write drivers that are drawn from a fitted population.

    Args:
        fitted: the fit.
        out: folder.
        size: number of drivers.
        seed: of the draws.
        speed_limit_mps: of the road that was recorded; with it, speeds rise and fall with the limits of other roads.

    Returns:
        the files.

    Raises:
        InputError: a file of the same name exists that this function did not write, or the folder is a run's.
    """
    require_output_folder(out)
    require_own_files([out / VTYPES_FILE], _VTYPES_NOTE)
    require_own_files([out / POPULATION_FILE], _POPULATION_NOTE)
    model = fitted.car_following
    drawn = draws(model, fitted.population.population.any_pair, size, seed)
    write_text(out / VTYPES_FILE, vtypes_xml(model, drawn, fitted.step_s, speed_limit_mps))
    write_text(out / POPULATION_FILE, population_yaml(model, drawn))
    plot(fitted, out / PICTURE_FILE)
    return [out / VTYPES_FILE, out / POPULATION_FILE, out / PICTURE_FILE]


def vtypes_xml(model: CarFollowing, drawn: Floats, step_s: float, speed_limit_mps: float | None = None) -> str:
    """Return a file for SUMO's --additional-files: the distribution ``drivers`` with a vType for each driver.

    Args:
        model: car-following model.
        drawn: (N, P) logarithms of the drivers' parameters.
        step_s: SUMO's step length in the fit.
        speed_limit_mps: of the road that was recorded. Without it, drivers drive as fast as their desired speed and the
            limit allow; with it, their speedFactor is the desired speed in units of this limit.
    """
    types = (
        f"        {vtype_xml(f'{DISTRIBUTION_ID}.{index}', model.vtype(z, speed_limit_mps))}"
        for index, z in enumerate(drawn)
    )
    note = f"    <!-- {_VTYPES_NOTE} of {step_s:g} s; headways below the step length cannot be kept. -->"
    head = f'    <vTypeDistribution id="{DISTRIBUTION_ID}">'
    return "\n".join(["<additional>", note, head, *types, "    </vTypeDistribution>", "</additional>", ""])


def population_yaml(model: CarFollowing, drawn: Floats) -> str:
    """Return a configuration file whose ``population`` has traits as before, and follows as these drivers."""
    names = [parameter.name for parameter in model.parameters]
    columns = [names.index(field.name) for field in fields(FittedDriver)]
    drivers = [FittedDriver(*(round(float(value), 4) for value in np.exp(z[columns]))) for z in drawn]
    hardest = max(driver.decel_mps2 for driver in drivers)
    idm = {"emergency_decel_mps2": hardest} if hardest > Idm.emergency_decel_mps2 else {}
    population = {
        "members": len(drivers),
        "car_following": model.name,
        **({"idm": idm} if idm else {}),
        "fitted": [plain(driver) for driver in drivers],
    }
    note = (
        f"{_POPULATION_NOTE}: they keep their headway, minimum gap, acceleration and braking. "
        "How fast they want to go, whether they yield and how they enter is as in the population's base."
    )
    return to_yaml({"population": {"base": "traits", **population}}, {"population": note})


def plot(fitted: Fitted, file: Path) -> None:
    """Write a picture of the distribution of each parameter: drivers, population and SUMO's default."""
    model, one = fitted.car_following, fitted.population.population
    figure = Figure(figsize=(3.0 * len(model.parameters), 4.2), dpi=120, layout="constrained")
    estimates = [driver.fit.estimate for driver in fitted.drivers]
    deviations = np.sqrt(np.diag(one.total))
    for index, (parameter, axes) in enumerate(
        zip(model.parameters, np.atleast_1d(figure.subplots(1, len(model.parameters))), strict=True)
    ):
        _plot_density(axes, parameter, one.mean[index], deviations[index])
        order = np.argsort([estimate.log_parameters[index] for estimate in estimates])
        for rank, driver in enumerate(order):
            low, high = (np.exp(end[index]) for end in estimates[driver].interval(model))
            height = -0.05 - 0.9 * (rank + 0.5) / len(order)
            axes.plot([low, high], [height, height], color=_RECORDED, linewidth=0.8, alpha=0.5)
            axes.plot(np.exp(estimates[driver].log_parameters[index]), height, ".", color=_RECORDED, markersize=4)
        axes.axvline(parameter.default, color=_DEFAULT, linestyle="--", linewidth=1.2, label="SUMO's default")
        axes.set(xlabel=f"{parameter.title} ({parameter.unit})", yticks=[], ylim=(-1.0, 1.1), xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    figure.axes[0].legend(loc="upper left", fontsize=8)
    figure.axes[0].set_ylabel("drivers, with 95 % intervals          population", fontsize=8)
    figure.suptitle(f"{fitted.model} fitted to {len(fitted.drivers):,} drivers ({len(fitted.pairs):,} pairs)")
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")


def _plot_density(axes: Axes, parameter: Parameter, mean: float, deviation: float) -> None:
    low, high = np.clip(
        norm.ppf([_OUTER, 1.0 - _OUTER], mean, deviation), np.log(parameter.low), np.log(parameter.high)
    )
    logs = np.linspace(low, high, 200)
    density = norm.pdf(logs, mean, deviation)
    axes.fill_between(np.exp(logs), density / density.max(), color=_RECORDED, alpha=0.35, label="recorded drivers")
