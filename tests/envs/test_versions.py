"""Episodes of an environment never change within a version of its id: trained policies rely on that."""

import hashlib

import gymnasium
import numpy as np
import pytest

from tint_sumo import ENV_IDS
from tint_sumo.envs.batch import LocalBatch
from tint_sumo.envs.rows import TRACKS
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.scenes import T_INTERSECTION
from tint_sumo.simulation import SceneSimulation

# Digests of the states under the actions below, computed when TIntersection-v1 was registered.
T_INTERSECTION_V1 = "845b4ba7b9c15091bd26cb1fd64ee7697bb1266f0c2cf7136772ea95e2f3f6e7"

# Of the observations and infos with tracks, perfect and with white noise of 0.1 m, as they were before there were
# other sensors.
T_INTERSECTION_V1_SEEN = {
    0.0: "2ceb742da227a6d0ed370f26642a6dd2a6ad1a9d8e3e4b8e2b9b2e81cb5321bc",
    0.1: "6fe6aa1f7ff3e17696589b345e93129b4b33b81138b789de1942751ed46facd7",
}


def test_episodes_of_the_t_intersection_are_those_of_its_version() -> None:
    replicas, steps, rng = 16, 450, np.random.default_rng(7)
    chosen = rng.integers(0, 3, (steps // 5 + 1, replicas))
    goes = rng.random((steps // 5 + 1, replicas)) < 0.5
    actions = np.where(goes, 2, chosen).repeat(5, axis=0)[:steps]
    env = gymnasium.make_vec(
        ENV_IDS[T_INTERSECTION],
        num_envs=replicas,
        vectorization_mode="vector_entry_point",
        p_conservative=(0.1, 0.9),
        autoreset_mode="SameStep",
    )
    assert isinstance(env, SceneVectorEnv) and isinstance(env.batch, LocalBatch)
    simulation, found = env.batch.episodes.simulation, hashlib.sha256()
    assert isinstance(simulation, SceneSimulation)
    try:
        env.reset(seed=3)
        for taken in actions:
            _, _, terminated, truncated, _ = env.step(taken)
            slots, egos = simulation.slots, simulation.egos
            yielding, ends = simulation.yielding, terminated | truncated
            of_slots = (slots.route, slots.front_m, slots.member, slots.vehicle_number, yielding.reacts)
            of_egos = (egos.front_m, egos.speed_mps, yielding.has_claimed, simulation.time_s, ends)
            for values in (*(np.where(slots.present, one, -1) for one in of_slots), *of_egos):
                found.update(values.astype(float).tobytes())
    finally:
        env.close()
    assert found.hexdigest() == T_INTERSECTION_V1


@pytest.mark.parametrize("noise_m", T_INTERSECTION_V1_SEEN)
def test_what_is_seen_of_the_t_intersection_is_that_of_its_version(noise_m: float) -> None:
    rng, found = np.random.default_rng(7), hashlib.sha256()
    env = gymnasium.make_vec(
        ENV_IDS[T_INTERSECTION],
        num_envs=6,
        vectorization_mode="vector_entry_point",
        p_conservative=(0.1, 0.9),
        tracks=True,
        autoreset_mode="SameStep",
        position_noise_m=noise_m,
    )
    try:
        observation, infos = env.reset(seed=3)
        for _ in range(250):
            seen = (
                *(observation[key] for key in ("ego", "vehicles", "mask")),
                infos["traits"].astype(np.int8),  # labels had one byte in the beginning
                *(infos[key] for key in TRACKS[:3]),  # there were no others in the beginning
            )
            for values in seen:
                found.update(np.ascontiguousarray(values).tobytes())
            observation, *_, infos = env.step(rng.integers(0, 3, 6))
    finally:
        env.close()
    assert found.hexdigest() == T_INTERSECTION_V1_SEEN[noise_m]
