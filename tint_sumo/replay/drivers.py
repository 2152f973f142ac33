"""Drivers of recorded vehicles that are released: SUMO's defaults, one model for all, or each as fitted."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from tint_sumo.config import FittedDriver
from tint_sumo.core.errors import InputError, shown
from tint_sumo.drivers.fitted import Fitted, read_fitted
from tint_sumo.drivers.models import CarFollowing, Floats
from tint_sumo.scenes.replay import Recording

_MODEL = "carFollowModel"
_LEAST_MPS = 1.0  # where nobody moves

AnyDrivers = FittedDriver | Fitted | str | Path | None  # what users write


def find_drivers(drivers: AnyDrivers) -> Fitted | FittedDriver | None:
    """Return the drivers that a user means; a path is that of a fit.

    Raises:
        InputError: they are none, or there is no such fit.
    """
    if drivers is None or isinstance(drivers, Fitted | FittedDriver):
        return drivers
    if not isinstance(drivers, str | Path):
        raise InputError(
            f"drivers must be the folder of a fit (tint-sumo drivers fit), a FittedDriver or None, not {shown(drivers)}"
        )
    return read_fitted(Path(drivers))


def attributes_of(
    drivers: Fitted | FittedDriver | None, recording: Recording, limit_mps: Floats
) -> tuple[Mapping[str, float], ...]:
    """Return the attributes of the vType of each recorded vehicle, beside those of its label.

    A fit seldom knows how fast a driver would be on a free road. So nobody wants to drive faster than it was recorded
    at its fastest; those who were slow all the time, by less than half of the others' median, want to be as fast as
    that median. Roads with lower limits are driven on as much slower.

    Args:
        drivers: as in ``find_drivers``.
        recording: N vehicles.
        limit_mps: (N,) highest speed limit on the route of each.
    """
    if not isinstance(drivers, Fitted):
        return ({},) * len(recording.vehicles)
    model, median = drivers.car_following, np.array(drivers.population.mean.log_parameters)
    fits = {fit.name: np.array(fit.fit.log_parameters) for fit in drivers.drivers}
    return tuple(
        _attributes(model, fits.get(f"{recording.name}/{vehicle}", median), most_mps, limit)
        for vehicle, most_mps, limit in zip(
            recording.vehicles, _most_mps(recording).tolist(), limit_mps.tolist(), strict=True
        )
    )


def _most_mps(recording: Recording) -> Floats:
    """Return the speeds beyond which drivers do not want to drive; (N,)."""
    ends = recording.first_row + recording.rows
    fastest_mps = np.array(
        [
            recording.speed_mps[first:end].max()
            for first, end in zip(recording.first_row.tolist(), ends.tolist(), strict=True)
        ]
    )
    usual_mps = np.median(fastest_mps)
    return np.where(fastest_mps < usual_mps / 2.0, usual_mps, fastest_mps)


def _attributes(model: CarFollowing, log_parameters: Floats, most_mps: float, limit_mps: float) -> dict[str, float]:
    kept = np.clip(log_parameters, model.low, model.high)
    speed = [parameter.name for parameter in model.parameters].index("desired_speed_mps")
    kept[speed] = min(kept[speed], np.log(max(most_mps, _LEAST_MPS)))
    attributes = model.vtype(kept, limit_mps)
    return {name: float(value) for name, value in attributes.items() if name not in (_MODEL, *_fixed(model))}


def _fixed(model: CarFollowing) -> dict[str, str]:
    return {**dict(model.attributes), "speedDev": "0"}


def types_xml(labels: Iterable[str], drivers: Fitted | FittedDriver | None) -> str:
    """Return a vType for each label."""
    attributes = _shared(drivers)
    text = " ".join(f"{name}={quoteattr(value)}" for name, value in attributes.items())
    return "".join(f"<vType id={quoteattr(label)} {text}/>" for label in labels)


def _shared(drivers: Fitted | FittedDriver | None) -> dict[str, str]:
    """Return the attributes that all vTypes have."""
    if drivers is None:
        return {}
    if isinstance(drivers, Fitted):
        return {_MODEL: drivers.model, **_fixed(drivers.car_following)}
    return {
        _MODEL: "IDM",
        "tau": f"{drivers.tau_s:g}",
        "minGap": f"{drivers.min_gap_m:g}",
        "accel": f"{drivers.accel_mps2:g}",
        "decel": f"{drivers.decel_mps2:g}",
        "speedDev": "0",
    }
