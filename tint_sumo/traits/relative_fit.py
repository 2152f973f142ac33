"""Fit of relative traits to traffic without labels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from tint_sumo.config import ALL_MIXES, RelativeLatent, RelativeSettings
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.episodes import action_space
from tint_sumo.envs.worlds import find_world, tasks_in
from tint_sumo.scenes import AnyScene, find_scene
from tint_sumo.traits.perceived import Explorer, Perceived, perceive
from tint_sumo.traits.relative import LATENTS, STATISTICS, Floats, RelativeStream, densities, learn, numbers, prior

STEPS = 500  # of the simulation in each environment: one episode
NUM_ENVS = 288  # 32 for each of nine sensors
_FIRST_SEED = 2**31  # of environments; cases of evaluations have lower ones
_PAUSE_STEPS = 20  # between the two parts of a track, of which one predicts the other
_HALF_KNOWN_STEPS = 10.0  # first guess of the steps that tell half of what can be known of a driver
_GROUP_STDS = (0.2, 0.3, 0.4, 0.5, 0.7)  # that are tried
_DRIVER_STEPS = (5.0, 10.0, 20.0, 40.0, 80.0)  # that are tried
_ROUNDS = 3  # of expectation maximisation
_LEAST = 1e-6  # variance between towns


def traffic_in(world: str, scene: str | AnyScene, seed: int) -> Perceived:
    """Return traffic of all mixes of drivers in a world, for ``fit_relative`` or to measure its result.

    Args:
        world: its name.
        scene: a built-in one.
        seed: gives the same traffic in each of two calls; evaluations and trainings have other traffic.

    Raises:
        InputError: there is no such world or scene, or the scene is a SUMO configuration.
    """
    tasks = tasks_in(find_world(world), TaskSettings(find_scene(scene), ALL_MIXES))
    return traffic(tasks, _FIRST_SEED + seed * NUM_ENVS)


def traffic(tasks: Sequence[TaskSettings], seed: int, *, steps: int = STEPS, num_envs: int = NUM_ENVS) -> Perceived:
    """Return traffic around egos that move now and then; the environments are shared out among the tasks."""
    actions = int(action_space(tasks[0].played).n)
    return perceive(tasks, steps, num_envs, seed, Explorer(num_envs, actions, seed))


def follow(settings: RelativeSettings, seen: Perceived) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Return relative traits (T, N, V, 2) of all drivers in traffic, from what has been seen up to each step.

    Then come the sums (T, N, V, 2) of time gap and gap over the steady steps of each track so far, and their number
    (T, N, V).
    """
    steps, num_envs, slots = seen.present.shape
    stream, envs = RelativeStream(settings, num_envs, slots), np.arange(num_envs)
    traits = np.zeros((*seen.present.shape, LATENTS), np.float32)
    total, count = np.zeros((*seen.present.shape, STATISTICS)), np.zeros(seen.present.shape)
    for step in range(steps):
        stream.begin(np.flatnonzero(seen.begins[step]))
        traits[step] = stream.advance(envs, seen.present[step], seen.position_m[step], seen.gap_m[step])
        total[step], count[step] = stream.total, stream.count
    return traits, total, count


def fit_relative(seen: Perceived, settings: RelativeSettings | None = None) -> RelativeSettings:
    """Return relative traits fitted to traffic, of which no label is read.

    Each track is cut in two parts. The weights are those for which both parts differ most from the other drivers of
    the episode in comparison with how much they differ from each other (a linear discriminant analysis whose classes
    are the drivers). All else is what makes the tracks of all episodes likeliest.

    Args:
        seen: traffic.
        settings: limits of steady motion; nothing else of it is used.

    Raises:
        InputError: there are too few tracks of drivers who follow steadily.
    """
    given = RelativeSettings() if settings is None else settings
    tracks = _Tracks.of(seen, given)
    weights = _direction(tracks)
    return replace(given, latent=_latent(tracks.combined(weights), weights))


@dataclass(frozen=True)
class _Tracks:
    """M tracks that can be compared with others of their episode, and with themselves at another time."""

    episode: NDArray[np.int64]  # (M,) from 0
    mean: Floats  # (M, 2) of time gap and gap over all steady steps, or (M,) of their weighted sum
    count: Floats  # (M,) number of these steps
    first_mean: Floats  # like ``mean``, until one second before the track's middle
    last_mean: Floats  # from one second after it on

    @classmethod
    def of(cls, seen: Perceived, settings: RelativeSettings) -> Self:
        _, total, count = follow(settings, seen)
        begins, ends = seen.begins_track, seen.present.copy()
        ends[:-1] &= ~seen.present[1:] | begins[1:]
        env, slot, first = np.nonzero(np.moveaxis(begins, 0, -1))  # both in the order of environment, slot and time
        last = np.nonzero(np.moveaxis(ends, 0, -1))[2]
        middle = (first + last) // 2
        before = np.maximum(middle - _PAUSE_STEPS // 2, first)
        after = np.minimum(middle + _PAUSE_STEPS // 2, last)
        sums = np.concatenate([total, count[..., None]], axis=-1)
        whole, early = sums[last, env, slot], sums[before, env, slot]
        late = whole - sums[after, env, slot]
        some = (early[:, -1] > 0) & (late[:, -1] > 0)
        parts = [part[some] for part in (whole, early, late)]
        _, episode = np.unique(seen.episode[first, env][some], return_inverse=True)
        if np.count_nonzero(np.bincount(episode) > 1) < 2:
            raise InputError(
                "relative traits need two episodes with two drivers each who follow their leader steadily twice; "
                "give more traffic"
            )
        mean, first_mean, last_mean = (part[:, :-1] / part[:, -1:] for part in parts)
        return cls(episode, mean, parts[0][:, -1], first_mean, last_mean)

    def combined(self, weights: Floats) -> Self:
        """Return the tracks with a weighted sum of the statistics in place of them."""
        means = {name: getattr(self, name) @ weights for name in ("mean", "first_mean", "last_mean")}
        return replace(self, **means)

    def sums(self, steps: float) -> tuple[Floats, Floats]:
        """Return w x and w (see ``relative``), summed over the tracks of each episode, and those of each track.

        They are (episodes, X + 1) and (M, X + 1) for X statistics.
        """
        share = (self.count / (self.count + steps))[:, None]
        own = np.hstack([share * self.mean.reshape(len(share), -1), share])
        whole = np.zeros((self.episode.max() + 1, own.shape[1]))
        np.add.at(whole, self.episode, own)
        return whole, own

    def others(self, steps: float) -> tuple[Floats, Floats]:
        """Return the weighted mean over the other tracks in the episode of each track, and the sum of their weights.

        Both are zero where there are none.
        """
        whole, own = self.sums(steps)
        alone = np.bincount(self.episode)[self.episode] == 1
        rest = np.where(alone[:, None], 0.0, whole[self.episode] - own)
        means = rest[:, :-1] / np.where(alone, 1.0, rest[:, -1])[:, None]
        return means.reshape(self.mean.shape), rest[:, -1]


def _direction(tracks: _Tracks) -> Floats:
    """Return weights (2,) of time gap and gap, so that the drivers of a town have a variance of 1.

    Raises:
        InputError: drivers show no lasting difference.
    """
    others, shares = tracks.others(_HALF_KNOWN_STEPS)
    compared = shares > 0
    first, last = (tracks.first_mean - others)[compared], (tracks.last_mean - others)[compared]
    both = first.T @ last / len(first)
    between = (both + both.T) / 2.0 / np.mean(1.0 + 1.0 / shares[compared])  # the others' mean varies, too
    within = (first - last).T @ (first - last) / len(first)
    weights: Floats = scipy.linalg.eigh(between, within)[1][:, -1]
    variance = float(weights @ between @ weights)
    if not variance > 0.0:
        raise InputError("the drivers show no lasting difference from their neighbours; give other traffic")
    return np.asarray(weights / np.copysign(np.sqrt(variance), weights[0]))  # longer time gaps count as more


def _latent(tracks: _Tracks, weights: Floats) -> RelativeLatent:
    """Return the model of the weighted sum, which the tracks have in place of the statistics."""
    sums, shares = tracks.sums(_HALF_KNOWN_STEPS)[0].T
    means = sums / shares
    town_std = np.sqrt(max(float(np.var(means) - np.mean(1.0 / shares)), _LEAST))
    time_gap_weight, gap_weight = (round(float(weight), 4) for weight in weights)
    start = RelativeLatent(time_gap_weight, gap_weight, round(float(np.mean(means)), 4), round(float(town_std), 4))
    tried = [replace(start, group_std=std, steps=steps) for std in _GROUP_STDS for steps in _DRIVER_STEPS]
    return max((_with_differences(tracks, latent) for latent in tried), key=lambda pair: pair[1])[0]


def _with_differences(tracks: _Tracks, latent: RelativeLatent) -> tuple[RelativeLatent, float]:
    """Return a latent with the likeliest probabilities of differences (expectation maximisation), and the likelihood.

    It is the logarithm of the density of all tracks' weighted sums, in nats per track, before the last of the rounds,
    which changes it little.
    """
    for _ in range(_ROUNDS):
        beliefs, density = _towns(tracks, latent)
        share = beliefs.sum(axis=(1, 3)).mean(axis=0)
        latent = replace(latent, differences=tuple(round(float(value), 4) for value in share))
    return latent, density


def _towns(tracks: _Tracks, latent: RelativeLatent) -> tuple[Floats, float]:
    """Return the beliefs (episodes, 3, 7, 29) after all tracks, and the mean logarithm of the tracks' densities."""
    towns = np.repeat(prior(latent)[None], tracks.episode.max() + 1, axis=0)
    one = replace(latent, time_gap_weight=1.0, gap_weight=0.0)  # tracks have the weighted sum already
    total, given = np.stack([tracks.mean * tracks.count, np.zeros_like(tracks.mean)], axis=-1), numbers(one)
    logs = [
        np.log(learn(towns[episode], densities(total[track], tracks.count[track], given, len(latent.differences))))
        for track, episode in enumerate(tracks.episode)
    ]
    return towns, float(np.mean(logs))
