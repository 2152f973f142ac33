"""Infos of environments among recorded vehicles: the case, who was released, and what is wrong in the recording."""

from dataclasses import fields
from typing import Any

import numpy as np

from tint_sumo.envs.rows import Rows
from tint_sumo.scenes.registry import AnyScene
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.simulation import ReplaySimulation
from tint_sumo.simulation.recorded import Faults

_REPLAYED = ("case", "released", *(field.name for field in fields(Faults)))


def replayed_infos(scene: AnyScene) -> tuple[str, ...]:
    """Return the names of the infos that a scene adds, which are those of the fields of its rows."""
    return _REPLAYED if isinstance(scene, ReplayScene) else ()


def replayed_fields(scene: AnyScene) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Return the fields that rows of a scene have for them."""
    return [(name, np.int64, ()) for name in replayed_infos(scene)]


def observe_recording(simulation: ReplaySimulation, rows: Rows) -> None:
    """Write the present values into the row (1,) of a simulation's environment."""
    row = rows[0]
    row["case"], row["released"] = simulation.scene.case, simulation.released
    for name, value in vars(simulation.faults).items():
        row[name] = value
