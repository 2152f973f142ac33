"""The loss of PPO, against values made by hand and against Stable-Baselines3's."""

import math
from typing import Any

import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch import Tensor

from tint_sumo.policy.loss import Decisions, PpoLoss, ppo_loss
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.ppo import RecurrentPPO

from .tasks import SMALL, FollowTheLeader


def tensor(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def loss_of(ratios: list[float], advantages: list[float], **given: Any) -> tuple[PpoLoss, Tensor]:
    """The loss of decisions with these ratios of probabilities, and its gradient by the logarithms of the ratios."""
    log_probs = tensor(*ratios).log().requires_grad_()
    zeros = torch.zeros_like(log_probs)
    parts = {"values": zeros, "returns": zeros, "entropies": zeros} | given
    loss = ppo_loss(
        Decisions(log_probs, zeros, tensor(*advantages), **parts), clip_range=0.2, ent_coef=0.1, vf_coef=0.5
    )
    (gradient,) = torch.autograd.grad(loss.total, log_probs)
    return loss, gradient


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective", "learns"),
    [
        (1.1, 2.0, 2.2, True),
        (1.5, 2.0, 2.4, False),  # more likely by more than 20 % already: nothing is gained
        (0.9, 2.0, 1.8, True),
        (0.5, 2.0, 1.0, True),  # a good action that has become unlikely: back
        (1.1, -2.0, -2.2, True),
        (1.5, -2.0, -3.0, True),  # a bad action that has become likely: back
        (0.9, -2.0, -1.8, True),
        (0.5, -2.0, -1.6, False),  # less likely by more than 20 % already
    ],
)
def test_a_decision_gains_nothing_beyond_the_clip_range(
    ratio: float, advantage: float, objective: float, learns: bool
) -> None:
    loss, gradient = loss_of([ratio], [advantage])
    assert loss.policy.item() == pytest.approx(-objective)
    assert loss.total.item() == pytest.approx(-objective)
    assert gradient.item() == pytest.approx(-advantage * ratio if learns else 0.0)


def test_the_loss_is_the_mean_over_the_decisions() -> None:
    loss, gradient = loss_of([1.1, 1.5, 0.5, 1.0], [2.0, 2.0, -2.0, 0.0])
    assert loss.policy.item() == pytest.approx(-(2.2 + 2.4 - 1.6) / 4)
    assert gradient.tolist() == pytest.approx([-2.2 / 4, 0.0, 0.0, 0.0])
    assert loss.clip_fraction.item() == 0.5
    kl = (0.1 - math.log(1.1) + 0.5 - math.log(1.5) - 0.5 - math.log(0.5)) / 4
    assert loss.approx_kl.item() == pytest.approx(kl)


def test_values_are_drawn_to_the_returns_with_their_weight() -> None:
    values = tensor(1.0, 4.0).requires_grad_()
    loss, _ = loss_of([1.0, 1.0], [0.0, 0.0], values=values, returns=tensor(2.0, 2.0))
    assert loss.value.item() == pytest.approx((1.0 + 4.0) / 2)
    assert loss.total.item() == pytest.approx(0.5 * 2.5)
    (gradient,) = torch.autograd.grad(
        ppo_loss(
            Decisions(tensor(0.0, 0.0), tensor(0.0, 0.0), tensor(0.0, 0.0), values, tensor(2.0, 2.0), None),
            clip_range=0.2,
            ent_coef=0.0,
            vf_coef=0.5,
        ).total,
        values,
    )
    assert gradient.tolist() == pytest.approx([0.5 * (1.0 - 2.0), 0.5 * (4.0 - 2.0)])


def test_entropy_is_rewarded() -> None:
    loss, _ = loss_of([1.0, 1.0], [0.0, 0.0], entropies=tensor(0.2, 0.6))
    assert loss.entropy.item() == pytest.approx(0.4)
    assert loss.total.item() == pytest.approx(-0.1 * 0.4)


def test_without_a_closed_form_the_likelihood_of_the_actions_estimates_the_entropy() -> None:
    loss, gradient = loss_of([0.5, 0.25], [0.0, 0.0], entropies=None)
    assert loss.entropy.item() == pytest.approx(1.5 * math.log(2.0))
    assert gradient.tolist() == pytest.approx([0.1 / 2, 0.1 / 2]), "unlikely actions are made more likely yet"


class Memoryless(GruPolicy):
    """The same network for Stable-Baselines3's PPO, in a task whose episodes have one step."""

    def evaluate_actions(self, obs: Any, actions: Tensor) -> Any:  # type: ignore[override]
        return super().evaluate_actions(obs, actions, self.initial_states(len(actions)), torch.ones(1, len(actions)))


def test_an_update_is_that_of_stable_baselines3() -> None:
    """From the same rollout, in an update of four epochs that leads out of the clip range."""
    settings: dict[str, Any] = {"n_steps": 8, "n_epochs": 4, "learning_rate": 3e-2, "ent_coef": 0.05, "vf_coef": 0.3}
    settings |= {"clip_range": 0.1, "max_grad_norm": 0.7, "policy_kwargs": {"settings": SMALL}, "device": "cpu"}
    env = FollowTheLeader(16)
    ours = RecurrentPPO("GruPolicy", env, n_minibatches=1, seed=0, **settings)
    theirs = PPO(Memoryless, env, batch_size=8 * 16, normalize_advantage=False, **settings)
    theirs.policy.load_state_dict(ours.policy.state_dict())

    def update() -> None:
        buffer, copy = ours.rollout_buffer, theirs.rollout_buffer
        for name in ("observations", "actions", "values", "log_probs", "returns"):
            setattr(copy, name, getattr(buffer, name))
        copy.advantages = (buffer.advantages - buffer.advantages.mean()) / (buffer.advantages.std() + 1e-8)
        copy.full = True
        RecurrentPPO.train(ours)

    ours.train = update  # type: ignore[method-assign]
    ours.learn(8 * 16)
    theirs.set_logger(Logger(None, []))
    theirs.train()
    measured = {name: value for name, value in ours.logger.name_to_value.items() if name.startswith("train/")}
    for name in ("policy_gradient_loss", "value_loss", "entropy_loss", "clip_fraction"):
        expected = theirs.logger.name_to_value[f"train/{name}"]
        assert measured[f"train/{name}"] == pytest.approx(expected, rel=1e-4, abs=1e-7), name
    assert measured["train/clip_fraction"] > 0.1
    for name, weights in ours.policy.state_dict().items():
        torch.testing.assert_close(theirs.policy.state_dict()[name], weights, msg=name)
