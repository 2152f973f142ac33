"""The loss of proximal policy optimisation (Schulman et al., 2017), as a function of numbers alone."""

from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Decisions:
    """B decisions of a rollout, with the policy's present probabilities and values."""

    log_probs: Tensor  # (B,) of the actions, now
    old_log_probs: Tensor  # (B,) of the actions, when they were taken
    advantages: Tensor  # (B,) of the actions
    values: Tensor  # (B,) of the observations, now
    returns: Tensor  # (B,) that followed
    entropies: Tensor | None  # (B,) of the actions' distributions, in nats; None where they have no closed form


@dataclass(frozen=True)
class PpoLoss:
    """Scalars; gradients reach back through the first four."""

    total: Tensor  # what is minimised
    policy: Tensor  # negative surrogate objective, clipped
    value: Tensor  # mean squared error of the values
    entropy: Tensor  # mean entropy, in nats
    approx_kl: Tensor  # estimate of KL(policy then || policy now) in nats (Schulman, 2020: (r - 1) - log r)
    clip_fraction: Tensor  # share of the decisions whose ratio is outside of the clip range


def ppo_loss(decisions: Decisions, *, clip_range: float, ent_coef: float, vf_coef: float) -> PpoLoss:
    """Return the loss of some decisions.

    Args:
        decisions: at least one.
        clip_range: the ratio of the probabilities now and then gains nothing beyond 1 - and 1 + this.
        ent_coef: weight of the entropy, which is rewarded.
        vf_coef: weight of the values' squared error.
    """
    log_ratio = decisions.log_probs - decisions.old_log_probs
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
    policy = -(decisions.advantages * ratio).minimum(decisions.advantages * clipped).mean()
    value = functional.mse_loss(decisions.values, decisions.returns)
    # Without a closed form, -log p of the actions taken estimates the entropy, as in Stable-Baselines3.
    entropy = (-decisions.log_probs if decisions.entropies is None else decisions.entropies).mean()
    return PpoLoss(
        total=policy - ent_coef * entropy + vf_coef * value,
        policy=policy,
        value=value,
        entropy=entropy,
        approx_kl=(ratio - 1.0 - log_ratio).mean().detach(),
        clip_fraction=((ratio - 1.0).abs() > clip_range).float().mean(),
    )
