"""Relative traits: how a driver follows its leader, compared with the others around it.

Drivers of one town keep longer headways than those of another, so a driver shows what it is only in comparison with
its neighbours. What is compared is a weighted sum x of the time gap and the gap in metres that a driver keeps while it
follows its leader steadily: the sum by which drivers differ most from their neighbours, and least from themselves at
another time, in units of the standard deviation between the drivers of a town.

Drivers are of two groups; nobody says who is of which. In a town of mean T whose groups differ by D, those of the first
group, who keep longer gaps, have the mean T + D / 2, the others T - D / 2, and x over n steady steps of a driver's
track is normal around that with the variance s^2 (1 + k / n), or anything with a small probability. The belief about
a town is a probability for each T, D and share of the first group on a grid; each driver seen changes it by Bayes'
rule. From it and the driver's x follows the probability that a driver is of the first group. So a driver who keeps
longer gaps than its neighbours is known to yield only where the neighbours show that there are two groups.

The weights of x, the distributions of T and D among towns, s and k are fitted to traffic without labels
(``tint_sumo.traits.relative_fit``).
"""

import math
from dataclasses import astuple, dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import NO_LEADER_GAP_M, STEP_S, RelativeLatent, RelativeSettings
from tint_sumo.core.compiling import compiled

STATISTICS = 2  # time gap in s and gap in m
LATENTS = 2  # numbers of a driver: its belief, and how much of what can be known of it is known
SHARES = (0.2, 0.5, 0.8)  # of the first group, each as likely as the others
GRID = 0.3  # distance of the values of T, and half that of D
TOWNS = 29  # values of T, up to 4.2 from the mean of all towns
_EVERY_STEPS = 5  # between two beliefs
_OUTLIER, _OUTLIER_DENSITY = 0.01, 0.05  # probability of any x, and its density
_FAST, _SLOW = 0.3, 0.2  # weights of the newest step in two moving averages
_LAG_S = (1.0 / _SLOW - 1.0 / _FAST) * STEP_S  # by which the second is older than the first
_FIRST_STEPS = 3  # of a track, too few for averages
_NEW_LEADER_M = 3.0  # the gap jumps by more where the leader changes
_NO_LEADER_GAP_M, _STEP_S = NO_LEADER_GAP_M, STEP_S

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Memory:
    """All that is known of the tracks in N x V slots, and of those that have ended; changed in place."""

    seen: NDArray[np.bool_]  # (N, V) whether a track goes on
    steps: NDArray[np.int64]  # (N, V) since the track's first
    leader_steps: NDArray[np.int64]  # (N, V) since the leader's first
    motion: Floats  # (N, V, 5) position, fast and slow average of speed, fast and slow average of gap
    total: Floats  # (N, V, 2) sums of time gap and gap over the steady steps of the track
    count: Floats  # (N, V) number of these steps
    town: Floats  # (N, 3, 7, 29) belief about shares, D and T after all tracks that have ended
    step: NDArray[np.int64]  # (N,) since the episode's first
    traits: NDArray[np.float32]  # (N, V, 2) of the present vehicles

    @classmethod
    def empty(cls, num_envs: int, slots: int, shape_of_belief: tuple[int, ...]) -> Self:
        shape = (num_envs, slots)
        return cls(
            np.zeros(shape, np.bool_),
            np.zeros(shape, np.int64),
            np.zeros(shape, np.int64),
            np.zeros((*shape, 5)),
            np.zeros((*shape, STATISTICS)),
            np.zeros(shape),
            np.zeros((num_envs, *shape_of_belief)),
            np.zeros(num_envs, np.int64),
            np.zeros((*shape, LATENTS), np.float32),
        )


@dataclass(frozen=True)
class TownEstimate:
    """Estimate of the town that an episode is in."""

    rank: float  # share of all towns whose drivers keep shorter gaps
    differs: float  # probability that its two groups of drivers differ at all


class RelativeStream:
    """Relative traits of the vehicles that N egos see in V slots, with every step of 0.1 s.

    Args:
        settings: of the model.
        num_envs: N.
        slots: V.
    """

    def __init__(self, settings: RelativeSettings, num_envs: int, slots: int) -> None:
        self._prior = prior(settings.latent)
        self._memory = _Memory.empty(num_envs, slots, self._prior.shape)
        self._limits = np.array(astuple(settings.steady))
        self._latent = numbers(settings.latent)
        self._town_std = settings.latent.town_std

    @property
    def total(self) -> Floats:
        """(N, V, 2) sums of time gap and gap over the steady steps of each track so far."""
        return self._memory.total

    @property
    def count(self) -> Floats:
        """(N, V) numbers of these steps."""
        return self._memory.count

    def memory(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays with all that is known of the tracks, by name."""
        return dict(vars(self._memory))

    def begin(self, envs: NDArray[np.int64]) -> None:
        """Forget the episodes of some environments."""
        self._memory.seen[envs] = False
        self._memory.town[envs] = self._prior
        self._memory.step[envs] = 0

    def advance(
        self, envs: NDArray[np.int64], present: NDArray[np.bool_], position_m: Floats, gap_m: Floats
    ) -> NDArray[np.float32]:
        """Take one step in K environments; arrays are (K, V), and a slot stays empty for a step between two tracks.

        Returns:
            Two numbers of each driver, (K, V, 2), inferred anew every five steps: its belief, from -1, which surely
            does not yield, to 1, which surely does, and n / (n + k), 0 at first. Both are 0 in empty slots.
        """
        m = self._memory
        _observe(
            envs, present, position_m, gap_m, self._limits, self._latent,
            m.seen, m.steps, m.leader_steps, m.motion, m.total, m.count, m.town,
        )  # fmt: skip
        m.traits[envs] *= m.seen[envs][..., None]
        due = envs[m.step[envs] % _EVERY_STEPS == 0]
        if len(due):
            _infer(due, self._latent, m.seen, m.total, m.count, m.town, m.traits)
        m.step[envs] += 1
        return np.asarray(m.traits[envs])

    def town(self, env: int) -> TownEstimate:
        """Return what an environment's drivers say about their town so far, those who have left included."""
        m, differences = self._memory, self._prior.shape[1]
        town = m.town[env].copy()
        for slot in np.flatnonzero(m.seen[env] & (m.count[env] > 0)).tolist():
            learn(town, densities(m.total[env, slot], m.count[env, slot], self._latent, differences))
        deviation = GRID * (np.arange(TOWNS) - TOWNS // 2)
        level = float(town.sum(axis=(0, 1)) @ deviation) / self._town_std
        return TownEstimate(0.5 * (1.0 + math.erf(level / math.sqrt(2.0))), 1.0 - float(town[:, 0].sum()))


def numbers(latent: RelativeLatent) -> Floats:
    """Return the numbers of a latent that compiled functions take."""
    return np.array(
        [latent.time_gap_weight, latent.gap_weight, latent.town_mean, latent.group_std, latent.steps], np.float64
    )


def prior(latent: RelativeLatent) -> Floats:
    """Return the belief (3, 7, 29) about a town of which nothing is known."""
    deviation = GRID * (np.arange(TOWNS) - TOWNS // 2)
    towns = np.exp(-0.5 * np.square(deviation / latent.town_std))
    cells = np.ones(len(SHARES))[:, None, None] * np.array(latent.differences)[:, None] * towns
    return np.asarray(cells / cells.sum())


@compiled
def _observe(
    envs: NDArray[np.int64],
    present: NDArray[np.bool_],
    position_m: Floats,
    gap_m: Floats,
    limits: Floats,
    latent: Floats,
    seen: NDArray[np.bool_],
    steps: NDArray[np.int64],
    leader_steps: NDArray[np.int64],
    motion: Floats,
    total: Floats,
    count: Floats,
    town: Floats,
) -> None:
    """Add one step to all tracks of some environments; the last arguments are those of ``_Memory``."""
    least_speed, most_accel, farthest_leader, most_closing = limits
    for row, env in enumerate(envs):
        for slot in range(present.shape[1]):
            track = (env, slot)
            if not present[row, slot]:
                if seen[track] and count[track] > 0:
                    learn(town[env], densities(total[track], count[track], latent, town.shape[2]))
                seen[track] = False
                continue
            state, gap = motion[env, slot], min(gap_m[row, slot], _NO_LEADER_GAP_M)
            if not seen[track]:
                seen[track], steps[track], leader_steps[track], count[track] = True, -1, -1, 0.0
                state[:3], state[3:], total[track] = 0.0, gap, 0.0
            steps[track] += 1
            if steps[track] > 0:
                speed, newest = (position_m[row, slot] - state[0]) / _STEP_S, 1.0 / steps[track]
                state[1] += max(_FAST, newest) * (speed - state[1])
                state[2] += max(_SLOW, newest) * (speed - state[2])
            state[0] = position_m[row, slot]
            leader_steps[track] = 0 if abs(gap - state[3]) > _NEW_LEADER_M else leader_steps[track] + 1
            newest = 1.0 / (leader_steps[track] + 1)
            state[3] += max(_FAST, newest) * (gap - state[3])
            state[4] += max(_SLOW, newest) * (gap - state[4])
            steady = state[1] > least_speed and abs(state[1] - state[2]) < most_accel * _LAG_S
            follows = state[3] < farthest_leader and abs(state[3] - state[4]) < most_closing * _LAG_S
            if steady and follows and steps[track] >= _FIRST_STEPS:
                total[env, slot, 0] += state[4] / max(state[2], 0.5 * least_speed)
                total[env, slot, 1] += state[4]
                count[track] += 1.0


@compiled
def densities(total: Floats, count: float, latent: Floats, differences: int) -> Floats:
    """Return the density of a driver's x around each mean that a group can have, on the grid.

    Args:
        total: (2,) sums of time gap and gap over its steady steps.
        count: number of these, at least one.
        latent: numbers of the latent.
        differences: number of values of D.
    """
    x = (latent[0] * total[0] + latent[1] * total[1]) / count - latent[2]
    size = TOWNS + 2 * (differences - 1)
    std = latent[3] * np.sqrt(1.0 + latent[4] / count)
    x = min(max(x, -0.5 * GRID * (size - 1)), 0.5 * GRID * (size - 1))
    means = GRID * (np.arange(size) - 0.5 * (size - 1))
    normal = np.exp(-0.5 * ((x - means) / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    density: Floats = (1.0 - _OUTLIER) * normal + _OUTLIER * _OUTLIER_DENSITY
    return density


@compiled
def _of_groups(density: Floats, first: float, middle: int, d: int) -> tuple[float, float]:
    """Return the density of a driver's x as one of the first group, whose share is ``first``, and as one of the other.

    ``middle`` is the place of T on the grid; the groups' means are d places to either side.
    """
    return first * density[middle + d], (1.0 - first) * density[middle - d]


@compiled
def learn(town: Floats, density: Floats) -> float:
    """Change the belief about a town (3, 7, 29) by one driver's densities; return the density of its x."""
    shares, differences, towns = town.shape
    whole = 0.0
    for share in range(shares):
        first = SHARES[share]
        for d in range(differences):
            for t in range(towns):
                one, other = _of_groups(density, first, t + differences - 1, d)
                town[share, d, t] *= one + other
                whole += town[share, d, t]
    town /= whole
    return whole


@compiled
def probability(town: Floats, density: Floats) -> float:
    """Return the probability that a driver, whose densities the belief has learnt, is of the first group."""
    shares, differences, towns = town.shape
    found = 0.0
    for share in range(shares):
        first = SHARES[share]
        for d in range(differences):
            for t in range(towns):
                one, other = _of_groups(density, first, t + differences - 1, d)
                found += town[share, d, t] * one / (one + other)
    return found


@compiled
def _infer(
    envs: NDArray[np.int64],
    latent: Floats,
    seen: NDArray[np.bool_],
    total: Floats,
    count: Floats,
    town: Floats,
    traits: NDArray[np.float32],
) -> None:
    """Write the traits of all drivers in some environments; see ``RelativeStream.advance``."""
    slots, differences = seen.shape[1], town.shape[2]
    density = np.ones((slots, TOWNS + 2 * (differences - 1)))
    for env in envs:
        now = town[env].copy()
        for slot in range(slots):
            if seen[env, slot]:
                density[slot] = 1.0
                if count[env, slot] > 0:
                    density[slot] = densities(total[env, slot], count[env, slot], latent, differences)
                    learn(now, density[slot])
        for slot in range(slots):
            if seen[env, slot]:
                traits[env, slot, 0] = 2.0 * probability(now, density[slot]) - 1.0
                traits[env, slot, 1] = count[env, slot] / (count[env, slot] + latent[4])
