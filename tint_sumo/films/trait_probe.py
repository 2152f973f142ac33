"""Read traits from a policy's observation with a straight line, for viewers alone."""

import math
from dataclasses import dataclass, replace

import numpy as np
from sklearn.linear_model import LogisticRegression

from tint_sumo.config import CONSERVATIVE_LABEL, LATENT_SIZE, Mix
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.loading import Contender
from tint_sumo.policy.trait_sources import StreamingTraits, WithMotion
from tint_sumo.scenes.geometry import Floats

_ENVS, _STEPS = 8, 200  # environments and steps of the observed traffic
_EVERY = 5  # steps: neighbouring ones say the same
_MIX = Mix(0.5)
_WAIT = 0  # action of the ego in that traffic
_PROBIT = math.pi / 8  # how the uncertainty of an input flattens a logistic function (MacKay 1992)


@dataclass(frozen=True)
class TraitReader:
    """A straight line between the traits, in the space of the traits in a policy's observation.

    It only shows viewers what the numbers mean: it was fitted to the true traits of other traffic.
    """

    weights: Floats  # (D,) of the first numbers of each driver
    bias: float
    has_spread: bool  # whether the numbers that follow are the first ones' standard deviations
    before: int = 0  # numbers of each driver's motion, which come before its traits

    def p_conservative(self, observed: Floats) -> Floats:
        """Return probabilities (...) of conservative drivers, from observed traits (..., Z); NaN where all are 0."""
        size, observed = len(self.weights), observed[..., self.before :]
        logit = observed[..., :size] @ self.weights + self.bias
        if self.has_spread:
            variance = (observed[..., size : 2 * size] * self.weights) ** 2
            logit = logit / np.sqrt(1.0 + _PROBIT * variance.sum(axis=-1))
        probability = 1.0 / (1.0 + np.exp(-logit))
        return np.where(observed.any(axis=-1), probability, np.nan)


def fit_reader(contender: Contender) -> TraitReader | None:
    """Return a reader fitted to some seconds of other traffic; None if the observation has no traits, or one alone."""
    if contender.source is None:
        return None
    source = contender.source()
    before, source = (source.before, source.inner) if isinstance(source, WithMotion) else (0, source)
    observed, traits = _look_at_traffic(contender)
    observed = observed[:, before:]
    known = observed.any(axis=-1)
    is_conservative = traits[known] == CONSERVATIVE_LABEL
    if len(np.unique(is_conservative)) < 2:
        return None
    has_spread = isinstance(source, StreamingTraits)
    inputs = observed[known][:, :LATENT_SIZE] if has_spread else observed[known]
    line = LogisticRegression(C=10.0).fit(inputs, is_conservative)
    return TraitReader(line.coef_[0], float(line.intercept_[0]), has_spread, before)


def _look_at_traffic(contender: Contender) -> tuple[Floats, Floats]:
    """Return observed traits of M drivers (M, Z), and their true traits (M,)."""
    venv = replace(contender, action_repeat=1).make_venv(_ENVS, TaskSettings(contender.scene, _MIX))
    observed, traits = [], []
    try:
        venv.seed(0)
        venv.reset()
        for step in range(_STEPS):
            observation, _, _, infos = venv.step(np.full(_ENVS, _WAIT))
            if step % _EVERY == 0:
                assert isinstance(observation, dict)
                there = observation["mask"] > 0.5
                observed.append(observation["traits"][there].astype(np.float64))
                traits.append(np.stack([info["traits"] for info in infos])[there])
    finally:
        venv.close()
    return np.concatenate(observed), np.concatenate(traits)
