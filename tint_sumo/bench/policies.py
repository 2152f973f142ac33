"""Speed of policies in training, beside sb3-contrib's recurrent PPO where it is installed, and time of a decision."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from statistics import median
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo import traits
from tint_sumo.bench.measuring import Clocks, Turn, turns_apart
from tint_sumo.config import ALL_MIXES, PpoSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.registry import find_learned
from tint_sumo.methods.training import new_model, training_venv
from tint_sumo.policy import ActionRepeat, GruPolicy, StreamingTraits, TraitObservation
from tint_sumo.scenes import paper_scene
from tint_sumo.traits.storage import shipped_model

DECISION_METHOD = (
    "a decision: with one intersection and one thread, trait inference at every simulation step of a decision and one "
    "call of the network, with all wrappers; steps of the environment itself do not count"
)

_LEAST_DECISIONS = 1_000  # of a turn: the paper's rollouts are much shorter than the study's

MakeModel = Callable[[VecEnv, int, PpoSettings], OnPolicyAlgorithm]


@dataclass(frozen=True)
class TrainingSpeed:
    """Decisions per second of PPO with a budget's settings, without traits, in one process with one thread."""

    budget: str
    decisions_per_s: float
    recurrent_ppo_decisions_per_s: float | None  # the same of sb3-contrib's; None where that is not installed
    ratio: float | None  # of the two

    def rows(self) -> list[tuple[str, str]]:
        ours = (f"training a policy, budget {self.budget}", f"{self.decisions_per_s:,.0f} decisions/s")
        if self.recurrent_ppo_decisions_per_s is None:
            missing = "sb3-contrib is not installed: pip install sb3-contrib"
            return [ours, ("  with sb3-contrib's RecurrentPPO", missing)]
        return [
            ours,
            ("  with sb3-contrib's RecurrentPPO", f"{self.recurrent_ppo_decisions_per_s:,.0f} decisions/s"),
            ("  our speed to its", f"{self.ratio:.2f}"),
        ]


def training_speed(budget: str, settings: PpoSettings, turns: int) -> TrainingSpeed:
    """Measure in turns, each in another process, rollouts of our PPO with their updates, and the same of sb3-contrib's.

    The first turn of each, in which all episodes begin together, does not count.
    """
    makers: list[MakeModel] = [new_model]
    if find_spec("sb3_contrib"):
        makers.append(_contrib_model)
    with ExitStack() as stack:
        trainings = [stack.enter_context(turns_apart(_training, make, settings)) for make in makers]
        _, *speeds = [[turn() for turn in trainings] for _ in range(1 + turns)]
    compared = len(makers) == 2
    return TrainingSpeed(
        budget,
        median(ours for ours, *_ in speeds),
        median(theirs for _, theirs in speeds) if compared else None,
        median(ours / theirs for ours, theirs in speeds) if compared else None,
    )


@contextmanager
def _training(make: MakeModel, settings: PpoSettings) -> Iterator[Turn]:
    """Give turns that measure the decisions per second of more rollouts with their updates, as in the study."""
    venv = training_venv(find_learned("no_labels"), None, ALL_MIXES, settings, [paper_scene()])
    with closing(venv), single_threaded():
        model = make(venv, 0, settings)
        model.set_logger(Logger(None, []))
        decisions = settings.whole_rollouts(_LEAST_DECISIONS)

        def turn() -> float:
            start = time.perf_counter()
            model.learn(decisions, reset_num_timesteps=False)
            return decisions / (time.perf_counter() - start)

        yield turn


def _contrib_model(venv: VecEnv, seed: int, settings: PpoSettings) -> OnPolicyAlgorithm:
    """Return a model with as many and as large gradient steps, LSTMs and heads; without attention it does less."""
    from sb3_contrib import RecurrentPPO  # noqa: PLC0415 - optional

    heads = list(settings.policy.head_sizes)
    return RecurrentPPO(
        "MultiInputLstmPolicy",
        venv,
        n_steps=settings.n_steps,
        batch_size=settings.rollout // settings.n_minibatches,
        n_epochs=settings.n_epochs,
        policy_kwargs={"lstm_hidden_size": settings.policy.hidden_size, "net_arch": {"pi": heads, "vf": heads}},
        seed=seed,
    )


def decision_ms(settings: PpoSettings, decisions: int) -> float:
    """Return the median time of a decision (``DECISION_METHOD``) with streaming traits and the study's network."""
    env = SceneVecEnv(1, TaskSettings(tracks=True), seed=0)
    observed = TraitObservation(env, StreamingTraits(traits.load(shipped_model("cross_window"))))
    with closing(ActionRepeat(observed, settings.action_repeat)) as venv, single_threaded():
        policy = GruPolicy(venv.observation_space, venv.action_space, lambda _: 0.0, settings=settings.policy)
        clocks = Clocks()
        clocks.watch(env)
        decide = clocks.around(_driving(policy, venv), "decision")
        spent_s = [0.0]
        for _ in range(decisions):
            decide()
            spent_s.append(clocks.spent_s["decision"])
    return 1e3 * float(np.median(np.diff(spent_s)))


def _driving(policy: GruPolicy, venv: VecEnv) -> Callable[[], None]:
    """Return a function that makes one more decision."""
    observation: Any = venv.reset()
    state, starts = None, np.ones(venv.num_envs, bool)

    def decide() -> None:
        nonlocal observation, state, starts
        actions, state = policy.predict(observation, state=state, episode_start=starts, deterministic=True)
        observation, _, starts, _ = venv.step(actions)

    return decide
