"""One way to talk to SUMO: ``libsumo`` in this process, or ``traci`` to a ``sumo`` subprocess.

libsumo holds one simulation per process, so a second environment in the same process (Stable-Baselines3's
``EvalCallback`` has one) gets a subprocess, and so does the first one where the user's own program runs libsumo.
"""

import os
import subprocess
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import libsumo
from sumolib.miscutils import getFreeSocketPort
from traci import main as traci  # with LIBSUMO_AS_TRACI the package itself is libsumo under another name
from traci.exceptions import FatalTraCIError, TraCIException

from tint_sumo.config import Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.network import sumo_program

_CONNECT_TRIES, _CONNECT_WAIT_S = 600, 0.05  # sumo takes a moment to listen
LOAD_STATE = "load-state"
SUMO_ERRORS = (libsumo.TraCIException, libsumo.FatalTraCIError, TraCIException, FatalTraCIError)
_SIMULATION_OPTIONS = ("--net-file", "--route-files", "--seed")  # in which simulations differ


@dataclass(frozen=True)
class Connection:
    """A running simulation. ``vehicle`` to ``simulation`` are SUMO's TraCI domains."""

    backend: Literal["libsumo", "traci"]
    vehicle: Any
    vehicletype: Any
    person: Any
    lane: Any
    edge: Any
    route: Any
    polygon: Any
    trafficlight: Any
    simulation: Any
    lane_position_m: Callable[[str], float]  # vehicle.getLanePosition, which is called more often than all else
    step: Callable[..., Any]  # one step or, with a time, all steps until then
    load: Callable[[list[str]], Any]  # begin anew with these options
    close: Callable[[], None]


def connect(options: Sequence[str], backend: Backend = "auto") -> Connection:
    """Start SUMO with command-line ``options`` (https://sumo.dlr.de/docs/sumo.html).

    ``auto`` takes libsumo if it is free in this process and traci otherwise. A connection that nothing refers to any
    more is closed.

    Raises:
        InputError: libsumo was asked for but already runs a simulation in this process, or the name is unknown.
    """
    if backend not in ("auto", "libsumo", "traci"):
        raise InputError(f"unknown backend {backend!r}; choose auto, libsumo or traci")
    if backend == "traci":
        return _traci(options)
    with _lock:
        if libsumo_is_free():
            return _libsumo(options)
    if backend == "libsumo":
        raise InputError("libsumo already runs a simulation in this process; close it first or use backend='traci'")
    return _traci(options)


@dataclass(eq=False)
class _Claim:
    """The use of libsumo by one of our simulations."""

    options: list[str]  # that it was started or loaded with last
    process_id: int = field(default_factory=os.getpid)


_lock = threading.RLock()  # reentrant: garbage collection may close a simulation while another one starts
_claims: list[_Claim] = []  # at most one


def libsumo_is_free() -> bool:
    """Return whether this process can start a simulation in libsumo, which the user's own program may use, too.

    A forked process has a copy of its parent's simulation, and may start another one in its place.
    """
    return not libsumo.isLoaded() or any(claim.process_id != os.getpid() for claim in _claims)


def _libsumo(options: Sequence[str]) -> Connection:
    claim = _Claim(list(options))
    _claims[:] = [claim]
    try:
        libsumo.start(["sumo", *options])
        # The Python function that SWIG puts around it would take a third of a call's time.
        lane_position_m = getattr(libsumo._libsumo, "vehicle_getLanePosition", libsumo.vehicle.getLanePosition)
        return _closed_when_forgotten(
            Connection(
                "libsumo",
                libsumo.vehicle,
                libsumo.vehicletype,
                libsumo.person,
                libsumo.lane,
                libsumo.edge,
                libsumo.route,
                libsumo.polygon,
                libsumo.trafficlight,
                libsumo.simulation,
                lane_position_m,
                libsumo.simulationStep,
                partial(_load, claim),
                partial(_release, claim),
            )
        )
    except BaseException:
        _release(claim)
        raise


def _load(claim: _Claim, options: list[str]) -> None:
    claim.options = options
    libsumo.load(options)


def _release(claim: _Claim) -> None:
    """End the simulation of a claim, but none that others have started since."""
    with _lock:
        if claim in _claims and claim.process_id == os.getpid():
            if libsumo.isLoaded() and _runs(claim.options):
                libsumo.close()
            _claims.clear()


def _runs(options: Sequence[str]) -> bool:
    """Return whether libsumo runs the simulation that has these options."""
    return all(
        libsumo.simulation.getOption(name.removeprefix("--")) == value
        for name, value in pairwise(options)
        if name in _SIMULATION_OPTIONS
    )


def _traci(options: Sequence[str]) -> Connection:
    port = getFreeSocketPort()
    command = [sumo_program("sumo"), *options, "--remote-port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        connection = _reach(port, process)
        connection.getVersion()  # sumo answers once it has loaded its input, whose files may then go
        return _closed_when_forgotten(
            Connection(
                "traci",
                connection.vehicle,
                connection.vehicletype,
                connection.person,
                connection.lane,
                connection.edge,
                connection.route,
                connection.polygon,
                connection.trafficlight,
                connection.simulation,
                connection.vehicle.getLanePosition,
                connection.simulationStep,
                _loads(connection.load),
                partial(_end, connection, process, os.getpid()),
            )
        )
    except BaseException:
        process.kill()
        process.wait()
        raise


def _loads(load: Callable[[list[str]], Any]) -> Callable[[list[str]], None]:
    """Return traci's ``load``, mended: after one with a state, SUMO 1.28 loads that state again where none is named."""
    had_state = False

    def load_once(options: list[str]) -> None:
        nonlocal had_state
        has_state = f"--{LOAD_STATE}" in options
        if had_state and not has_state:
            load(options)
        load(options)
        had_state = has_state

    return load_once


def _reach(port: int, process: "subprocess.Popen[bytes]") -> Any:
    """Connect as soon as sumo listens; traci's own retries would be printed."""
    for _ in range(_CONNECT_TRIES):
        with suppress(FatalTraCIError):
            return traci.connect(port, numRetries=0, proc=process)
        time.sleep(_CONNECT_WAIT_S)
    raise FatalTraCIError(f"sumo has not listened on port {port} for {_CONNECT_TRIES * _CONNECT_WAIT_S:g} s")


def _end(connection: Any, process: "subprocess.Popen[bytes]", process_id: int) -> None:
    """Kill sumo, which has nothing to save; only in the process that started it."""
    if process_id == os.getpid():
        process.kill()
        process.wait()
        with suppress(Exception):  # an interrupted call may have left anything behind
            if connection._socket is not None:  # traci would ask sumo to close, and wait for a call that holds its lock
                connection._socket.close()
                connection._socket = None
            connection.close(wait=False)


def _closed_when_forgotten(connection: Connection) -> Connection:
    weakref.finalize(connection, connection.close)
    return connection
