"""Episodes that a policy drives."""

from contextlib import closing
from functools import partial

import numpy as np
import pytest

from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.driving import DrivenEpisode, drive
from tint_sumo.methods.rules import GO, AlwaysGo

SEED = 40
make_venv = partial(SceneVecEnv, settings=TaskSettings(p_conservative=0.6, time_limit_s=6.0, decision_s=0.3))


def driven(random_share: float, batch: int = 8) -> list[DrivenEpisode]:
    with closing(drive(AlwaysGo(), make_venv, SEED, 8, batch, random_share)) as episodes:
        return sorted(episodes, key=lambda one: one.number)


def test_actions_are_those_of_the_decisions() -> None:
    venv = make_venv(1)
    with closing(venv):
        for episode in driven(0.0):
            assert set(episode.actions) == {GO}
            assert episode.seed == SEED + episode.number
            venv.seed(episode.seed)
            venv.reset()
            ends = [bool(venv.step(np.array([action]))[2][0]) for action in episode.actions]
            assert ends == [False] * (len(ends) - 1) + [True]


def test_a_share_of_the_actions_is_drawn_whatever_the_batch() -> None:
    drawn = driven(0.5)
    assert [one.actions for one in drawn] == [one.actions for one in driven(0.5, batch=3)]
    others = np.mean([action != GO for one in drawn for action in one.actions])
    assert others == pytest.approx(0.5 * 2 / 3, abs=0.1)
    assert drawn[0].actions[:10] != drawn[1].actions[:10]
    actions = [action for one in driven(1.0) for action in one.actions]
    assert np.bincount(actions) / len(actions) == pytest.approx(np.full(3, 1 / 3), abs=0.1)
