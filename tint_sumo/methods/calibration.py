"""Calibration of how readily a policy moves, after its training.

A training draws actions by their probabilities, a test takes the likeliest ones. Where going and waiting are worth
nearly the same, a policy that goes with a probability of 0.3 in each decision soon goes in training, and never in a
test. So a constant is added to the logits of all actions but the slowest, with which the likeliest actions earn most
in further episodes of the training's environments.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.methods.driving import drive
from tint_sumo.policy import GruPolicy

BIASES = (0.0, 0.5, 1.0, 1.5, 2.0)  # that are tried


@dataclass(frozen=True)
class Calibration:
    """Bias that was added to the logits of all actions but the slowest, and the mean return of each bias tried."""

    bias: float
    returns: dict[str, float]  # mean sum of rewards of an episode, by the bias


def calibrate(
    policy: GruPolicy,
    make_venv: Callable[[int], VecEnv],
    first_seed: int,
    episodes: int,
    batch: int,
    report: Report = silent,
) -> Calibration:
    """Change the bias of a policy's last layer so that its likeliest actions earn most.

    All biases are tried in the same episodes; of equal ones the smallest is taken.

    Args:
        policy: of discrete actions, the slowest first.
        make_venv: makes monitored environments of the training, so many at a time.
        first_seed: seed of the first episode; the others have the following ones.
        episodes: number of episodes for each bias.
        batch: environments at a time.
        report: called with the progress.
    """
    assert isinstance(policy.action_net, nn.Linear)
    trained = policy.action_net.bias.detach().clone()
    earned: dict[float, float] = {}
    for number, bias in enumerate(BIASES):
        _set_bias(policy.action_net, trained, bias)
        rewards = []
        with closing(drive(policy, make_venv, first_seed, episodes, batch)) as all_driven:
            for driven in all_driven:
                rewards.append(float(driven.info["episode"]["r"]))
                report(Progress(number * episodes + len(rewards), len(BIASES) * episodes, "episode"))
        earned[bias] = round(sum(sorted(rewards)) / episodes, 4)  # sorted: they come as they end
    best = max(BIASES, key=earned.__getitem__)
    _set_bias(policy.action_net, trained, best)
    return Calibration(best, {f"{bias:g}": mean for bias, mean in earned.items()})


@torch.no_grad()
def _set_bias(layer: nn.Linear, trained: torch.Tensor, moving: float) -> None:
    layer.bias.copy_(trained)
    layer.bias[1:] += moving
