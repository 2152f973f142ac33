import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import libsumo
import pytest
from traci.storage import Storage

from tests.scenes.networks import UserNetwork
from tests.simulation.scenes import T
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.sumo_run import SumocfgRun
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.sumocfg import SumocfgSimulation


def test_a_second_simulation_in_the_process_takes_traci_and_libsumo_comes_back() -> None:
    first, second = SceneSimulation(1, T), SceneSimulation(1, T)
    assert (first.backend, second.backend) == ("libsumo", "traci")
    with pytest.raises(InputError, match="libsumo already runs"):
        SceneSimulation(1, T, backend="libsumo")
    first.close()
    first.close()
    third = SceneSimulation(1, T, backend="libsumo")
    assert third.backend == "libsumo"
    second.close()
    third.close()


def test_traci_when_asked_for() -> None:
    simulation = SceneSimulation(1, T, backend="traci")
    assert simulation.backend == "traci"
    simulation.close()


def test_half_an_answer_that_an_interrupt_has_left_does_not_keep_traci_from_closing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulation = SceneSimulation(1, T, backend="traci")
    traci_connection = simulation.link.connection.vehicle._connection
    monkeypatch.setattr(traci_connection, "_recvExact", lambda: Storage(b""))
    simulation.close()


def test_a_lock_that_an_interrupt_has_left_does_not_keep_traci_from_closing() -> None:
    simulation = SceneSimulation(1, T, backend="traci")
    simulation.link.connection.vehicle._connection._lock.acquire()
    closing = threading.Thread(target=simulation.close, daemon=True)
    closing.start()
    closing.join(20.0)
    assert not closing.is_alive()


@pytest.fixture
def start_as_user(user_network: Callable[[str], UserNetwork]) -> Iterator[Callable[[], None]]:
    """Start a simulation in libsumo as the user's own program does, and step it once."""

    def start() -> None:
        libsumo.start(["sumo", *SumocfgRun(user_network("merge").scene().config).options(seed=5)])
        libsumo.simulationStep(10.0)

    yield start
    if libsumo.isLoaded():
        libsumo.close()


def test_where_the_user_runs_libsumo_simulations_take_traci(start_as_user: Callable[[], None]) -> None:
    start_as_user()
    with pytest.raises(InputError, match="libsumo already runs a simulation in this process"):
        SceneSimulation(1, T, backend="libsumo")
    simulation = SceneSimulation(1, T)
    assert simulation.backend == "traci"
    simulation.reset(0, 0)
    simulation.close()
    assert libsumo.simulation.getTime() == 10.0


def test_closing_never_ends_a_simulation_that_the_user_started_later(
    start_as_user: Callable[[], None], user_network: Callable[[str], UserNetwork]
) -> None:
    closed = SceneSimulation(1, T)
    closed.close()
    start_as_user()
    closed.close()
    del closed
    libsumo.close()
    for make in (lambda: SceneSimulation(1, T), lambda: SumocfgSimulation(1, user_network("merge").scene())):
        running = make()
        assert running.backend == "libsumo"
        start_as_user()  # libsumo ends the one that runs
        running.close()
        assert libsumo.simulation.getTime() == 10.0
        libsumo.close()


def test_libsumo_is_free_after_episodes_of_a_configuration(user_network: Callable[[str], UserNetwork]) -> None:
    simulation = SumocfgSimulation(1, user_network("merge").scene(warm_up_s=0.0), backend="libsumo")
    simulation.reset(0, 1)
    simulation.close()
    assert not libsumo.isLoaded()


def test_threads_claim_libsumo_once_and_keep_their_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    start = libsumo.start
    monkeypatch.setattr(libsumo, "start", lambda command: (time.sleep(0.5), start(command)))  # lets the others go on
    made: list[SceneSimulation] = []
    streams = sys.stdout, sys.stderr
    threads = [threading.Thread(target=lambda: made.append(SceneSimulation(1, T))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (sys.stdout, sys.stderr) == streams
    assert sorted(simulation.backend for simulation in made) == ["libsumo", "traci", "traci", "traci"]
    for simulation in made:
        simulation.reset(0, 1)
        simulation.close()


def test_a_forked_process_leaves_the_simulations_of_its_parent_alone() -> None:
    simulations = [SceneSimulation(1, T), SceneSimulation(1, T)]
    for simulation in simulations:
        simulation.reset(0, 1)
    child = os.fork()
    if child == 0:
        try:
            for simulation in simulations:
                simulation.close()
            again = SceneSimulation(1, T)
            os._exit(0 if again.backend == "libsumo" else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    for simulation in simulations:
        simulation.step()
        simulation.close()


def test_a_forgotten_simulation_gives_libsumo_free() -> None:
    simulation = SceneSimulation(1, T, backend="libsumo")
    del simulation
    gc.collect()
    again = SceneSimulation(1, T, backend="libsumo")
    again.close()


def test_unknown_backend() -> None:
    with pytest.raises(InputError, match="unknown backend 'gui'; choose auto, libsumo or traci"):
        SceneSimulation(1, T, backend="gui")  # type: ignore[arg-type]


def test_traci_says_nothing_on_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    SceneSimulation(1, T, backend="traci").close()
    assert capfd.readouterr().out == ""


def test_a_second_simulation_where_libsumo_stands_in_for_traci() -> None:
    """Users of other SUMO learning environments have this variable set; ``import traci`` then gives libsumo."""
    code = (
        "from tint_sumo.simulation import SceneSimulation\n"
        "from tint_sumo.scenes import find_scene\n"
        "first, second = (SceneSimulation(1, find_scene('t_intersection')) for _ in range(2))\n"
        "first.reset(0, 0), second.reset(0, 0), first.step(), second.step()\n"
        "assert (first.slots.front_m == second.slots.front_m).all() and first.slots.present.any()\n"
        "print(first.backend, second.backend)\n"
    )
    environment = os.environ | {"LIBSUMO_AS_TRACI": "1"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "libsumo traci"
