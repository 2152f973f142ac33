"""One way to talk to SUMO: ``libsumo`` in this process, or ``traci`` to a ``sumo`` subprocess.

libsumo holds one simulation per process, so a second environment in the same process (Stable-Baselines3's
``EvalCallback`` has one) gets a subprocess.
"""

import contextlib
import io
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import libsumo
from sumolib.miscutils import getFreeSocketPort
from traci import main as traci  # with LIBSUMO_AS_TRACI the package itself is libsumo under another name

from tint_sumo.config import Backend
from tint_sumo.errors import InputError
from tint_sumo.scenes.network import sumo_program

_CONNECT_TRIES, _CONNECT_WAIT_S = 600, 0.05  # sumo takes a moment to listen
_libsumo_owner: list[int] = []  # process id of the one libsumo simulation; a forked child does not inherit the claim


@dataclass(frozen=True)
class Connection:
    """A running simulation. ``vehicle``, ``vehicletype``, ``route`` and ``simulation`` are SUMO's TraCI domains."""

    backend: Literal["libsumo", "traci"]
    vehicle: Any
    vehicletype: Any
    route: Any
    simulation: Any
    lane_position_m: Callable[[str], float]  # vehicle.getLanePosition, which is called more often than all else
    step: Callable[..., Any]  # one step or, with a time, all steps until then
    load: Callable[[list[str]], Any]  # begin anew with these options
    close: Callable[[], None]


def connect(options: Sequence[str], backend: Backend = "auto") -> Connection:
    """Start SUMO with command-line ``options`` (https://sumo.dlr.de/docs/sumo.html).

    ``auto`` takes libsumo if it is free in this process and traci otherwise.

    Raises:
        InputError: libsumo was asked for but already runs a simulation in this process, or the name is unknown.
    """
    if backend not in ("auto", "libsumo", "traci"):
        raise InputError(f"unknown backend {backend!r}; choose auto, libsumo or traci")
    busy = not libsumo_is_free()
    if backend == "libsumo" and busy:
        raise InputError("libsumo already runs a simulation in this process; close it first or use backend='traci'")
    return _traci(options) if backend == "traci" or busy else _libsumo(options)


def libsumo_is_free() -> bool:
    """Whether this process can start a simulation in libsumo."""
    return os.getpid() not in _libsumo_owner


def _libsumo(options: Sequence[str]) -> Connection:
    libsumo.start(["sumo", *options])
    _libsumo_owner[:] = [os.getpid()]

    def close() -> None:
        if not libsumo_is_free():
            _libsumo_owner.clear()
            libsumo.close()

    # The Python function that SWIG puts around it would take a third of a call's time.
    lane_position_m = getattr(libsumo._libsumo, "vehicle_getLanePosition", libsumo.vehicle.getLanePosition)
    return Connection(
        "libsumo",
        libsumo.vehicle,
        libsumo.vehicletype,
        libsumo.route,
        libsumo.simulation,
        lane_position_m,
        libsumo.simulationStep,
        libsumo.load,
        close,
    )


def _traci(options: Sequence[str]) -> Connection:
    port = getFreeSocketPort()
    command = [sumo_program("sumo"), *options, "--remote-port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    with contextlib.redirect_stdout(io.StringIO()):  # traci prints every try
        connection = traci.connect(port, numRetries=_CONNECT_TRIES, proc=process, waitBetweenRetries=_CONNECT_WAIT_S)
    connection.getVersion()  # sumo answers once it has loaded its input, whose files may then go
    return Connection(
        "traci",
        connection.vehicle,
        connection.vehicletype,
        connection.route,
        connection.simulation,
        connection.vehicle.getLanePosition,
        connection.simulationStep,
        connection.load,
        connection.close,
    )
