"""How sure a policy can be of who yields, for people to look at."""

import math
from dataclasses import dataclass, replace

import numpy as np
from sklearn.linear_model import LogisticRegression

from tint_sumo.config import CONSERVATIVE_LABEL, LATENT_SIZE
from tint_sumo.methods.loading import Contender
from tint_sumo.policy.trait_sources import StreamingTraits
from tint_sumo.scenes.geometry import Floats

_ENVS, _STEPS = 8, 200  # environments and steps of the traffic that is looked at
_EVERY = 5  # steps: neighbouring ones say the same
_P_CONSERVATIVE = 0.5
_WAIT = 0  # action of the ego in that traffic
_PROBIT = math.pi / 8  # how the uncertainty of an input flattens a logistic function (MacKay 1992)


@dataclass(frozen=True)
class TraitReader:
    """A straight line through the space of what a policy is told of drivers, between the traits.

    It only tells people what the numbers mean: it was fitted to the true traits of other traffic.
    """

    weights: Floats  # (D,) of the first numbers of each driver
    bias: float
    has_spread: bool  # whether the numbers that follow are the first ones' standard deviations

    def p_conservative(self, told: Floats) -> Floats:
        """Probabilities (...) that drivers are conservative, of what is told of them (..., Z); NaN if nothing is."""
        size = len(self.weights)
        logit = told[..., :size] @ self.weights + self.bias
        if self.has_spread:
            variance = (told[..., size : 2 * size] * self.weights) ** 2
            logit = logit / np.sqrt(1.0 + _PROBIT * variance.sum(axis=-1))
        probability = 1.0 / (1.0 + np.exp(-logit))
        return np.where(told.any(axis=-1), probability, np.nan)


def fit_reader(contender: Contender) -> TraitReader | None:
    """Look at some seconds of other traffic; None where the policy is told nothing that tells drivers apart."""
    if contender.source is None:
        return None
    told, traits = _look_at_traffic(contender)
    known = told.any(axis=-1)
    is_conservative = traits[known] == CONSERVATIVE_LABEL
    if len(np.unique(is_conservative)) < 2:
        return None
    has_spread = isinstance(contender.source(), StreamingTraits)
    inputs = told[known][:, :LATENT_SIZE] if has_spread else told[known]
    line = LogisticRegression(C=10.0).fit(inputs, is_conservative)
    return TraitReader(line.coef_[0], float(line.intercept_[0]), has_spread)


def _look_at_traffic(contender: Contender) -> tuple[Floats, Floats]:
    """What the policy is told of drivers (M, Z), and their true traits (M,)."""
    venv = replace(contender, action_repeat=1).make_venv(_ENVS, p_conservative=_P_CONSERVATIVE)
    told, traits = [], []
    try:
        venv.seed(0)
        venv.reset()
        for step in range(_STEPS):
            observation, _, _, infos = venv.step(np.full(_ENVS, _WAIT))
            if step % _EVERY == 0:
                assert isinstance(observation, dict)
                there = observation["mask"] > 0.5
                told.append(observation["traits"][there].astype(np.float64))
                traits.append(np.stack([info["traits"] for info in infos])[there])
    finally:
        venv.close()
    return np.concatenate(told), np.concatenate(traits)
