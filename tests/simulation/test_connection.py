import gc
import os
import subprocess
import sys

import pytest

from tests.simulation.scenes import T
from tint_sumo.errors import InputError
from tint_sumo.simulation.simulation import Simulation


def test_a_second_simulation_in_the_process_takes_traci_and_libsumo_comes_back() -> None:
    first, second = Simulation(1, T), Simulation(1, T)
    assert (first.backend, second.backend) == ("libsumo", "traci")
    with pytest.raises(InputError, match="libsumo already runs"):
        Simulation(1, T, backend="libsumo")
    first.close()
    first.close()
    third = Simulation(1, T, backend="libsumo")
    assert third.backend == "libsumo"
    second.close()
    third.close()


def test_traci_when_asked_for() -> None:
    simulation = Simulation(1, T, backend="traci")
    assert simulation.backend == "traci"
    simulation.close()


def test_a_forgotten_simulation_gives_libsumo_free() -> None:
    simulation = Simulation(1, T, backend="libsumo")
    del simulation
    gc.collect()
    again = Simulation(1, T, backend="libsumo")
    again.close()


def test_unknown_backend() -> None:
    with pytest.raises(InputError, match="unknown backend 'gui'; choose auto, libsumo or traci"):
        Simulation(1, T, backend="gui")  # type: ignore[arg-type]


def test_traci_says_nothing_on_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    Simulation(1, T, backend="traci").close()
    assert capfd.readouterr().out == ""


def test_a_second_simulation_where_libsumo_stands_in_for_traci() -> None:
    """Users of other SUMO learning environments have this variable set; ``import traci`` then gives libsumo."""
    code = (
        "from tint_sumo.simulation.simulation import Simulation\n"
        "from tint_sumo.scenes import find_scene\n"
        "first, second = (Simulation(1, find_scene('t_intersection')) for _ in range(2))\n"
        "first.reset(0, 0), second.reset(0, 0), first.step(), second.step()\n"
        "assert (first.slots.front_m == second.slots.front_m).all() and first.slots.present.any()\n"
        "print(first.backend, second.backend)\n"
    )
    environment = os.environ | {"LIBSUMO_AS_TRACI": "1"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "libsumo traci"
