"""How recorded vehicles drive on once they are released: with SUMO's defaults, with one model for all, or as fitted."""

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

    A fit seldom knows how fast a driver would be on a free road: nobody wants to drive faster than the speed limit or,
    if that is more, than it was recorded. Slower roads are driven on as much slower.

    Args:
        drivers: as in ``find_drivers``.
        recording: N vehicles.
        limit_mps: (N,) highest speed limit on the route of each.
    """
    if not isinstance(drivers, Fitted):
        return ({},) * len(recording.vehicles)
    model, median = drivers.car_following, drivers.population.population.mean
    fits = {fit.name: np.array(fit.fit.log_parameters) for fit in drivers.drivers}
    ends = recording.first_row + recording.rows
    return tuple(
        _attributes(
            model,
            fits.get(f"{recording.name}/{vehicle}", median),
            max(float(recording.speed_mps[first:end].max()), limit),
            limit,
        )
        for vehicle, first, end, limit in zip(
            recording.vehicles, recording.first_row.tolist(), ends.tolist(), limit_mps.tolist(), strict=True
        )
    )


def _attributes(model: CarFollowing, log_parameters: Floats, most_mps: float, limit_mps: float) -> dict[str, float]:
    kept = np.clip(log_parameters, model.low, model.high)
    speed = [parameter.name for parameter in model.parameters].index("desired_speed_mps")
    kept[speed] = min(kept[speed], np.log(most_mps))
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
