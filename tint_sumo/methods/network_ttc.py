"""The time-to-collision rule for SUMO configurations, whose routes and right of way it does not know."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tint_sumo.methods.rules import Observation, State
from tint_sumo.scenes import SumocfgScene
from tint_sumo.scenes.geometry import Bools, Floats

_TIMES = 12  # times at which collisions are looked for, up to the threshold
_MOVING_MPS = 0.1  # slower vehicles are taken to stand, with a box along the ego's


@dataclass(frozen=True)
class NetworkTimeToCollision:
    """Takes the highest desired speed at which the ego would touch nobody within a threshold; the lowest if none is so.

    The ego is taken to drive straight on at the desired speed, and each vehicle straight on at its speed, which comes
    from the last two observations. A vehicle just seen is taken to stand, all are as large as the ego, and those behind
    it do not count. It sets off at once: the observation shows its heading when it moves.
    """

    scene: SumocfgScene
    threshold_s: float = 2.0
    margin_m: float = 0.5  # around the ego's box

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[NDArray[np.int64], State]:
        """Return actions (N,) for N observations; arguments and result as in Stable-Baselines3's ``predict``.

        The state holds where each slot's vehicle was seen from the ego (N, V, 2), which slots held one (N, V), and the
        ego's heading (N, 2), 0 before it has moved.
        """
        at_m = observation["vehicles"].astype(np.float64) * self.scene.position_scale_m
        present = observation["mask"] > 0.5
        velocity_mps = observation["ego"][:, 2:].astype(np.float64) * self.scene.speed_scale_mps
        if state is None:
            state = (at_m, np.zeros(present.shape), np.zeros((len(at_m), 2)))
        was_m, was_present, heading = state
        if episode_start is not None:
            was_present = np.where(episode_start[:, None], 0.0, was_present)
            heading = np.where(episode_start[:, None], 0.0, heading)
        speed_mps = np.hypot(*velocity_mps.T)
        moves = speed_mps > _MOVING_MPS
        heading = np.where(moves[:, None], velocity_mps / np.maximum(speed_mps, _MOVING_MPS)[:, None], heading)
        own_mps = speed_mps[:, None] * heading

        seen_twice = present & (was_present > 0.5)
        others_mps = np.where(seen_twice[:, :, None], (at_m - was_m) / self.scene.step_s + own_mps[:, None], 0.0)
        actions = self._fastest_free(at_m, present, others_mps, heading)
        return actions, (at_m, present.astype(np.float64), heading)

    @property
    def _speeds_mps(self) -> Floats:
        return np.array(self.scene.controller.desired_speeds_mps)

    def _fastest_free(self, at_m: Floats, present: Bools, others_mps: Floats, heading: Floats) -> NDArray[np.int64]:
        """Return the number of the highest desired speed (N,) at which the ego touches nobody; 0 if there is none."""
        half_length_m, half_width_m = self.scene.vehicle.length_m / 2, self.scene.vehicle.width_m / 2
        ahead, aside = heading[:, None], np.stack([-heading[:, 1], heading[:, 0]], axis=1)[:, None]
        # Half of the boxes' sizes along and across the ego's heading.
        others_speed = np.hypot(others_mps[..., 0], others_mps[..., 1])
        along = np.abs((others_mps * ahead).sum(axis=2)) / np.maximum(others_speed, _MOVING_MPS)
        along = np.where(others_speed > _MOVING_MPS, np.minimum(along, 1.0), 1.0)
        across = np.sqrt(1.0 - along**2)
        reach_m = half_length_m + self.margin_m + along * half_length_m + across * half_width_m
        width_m = half_width_m + self.margin_m + across * half_length_m + along * half_width_m
        has_moved = (heading != 0.0).any(axis=1, keepdims=True)  # before that, its heading is not known
        in_question = present & has_moved & ((at_m * ahead).sum(axis=2) > -half_length_m)  # not those behind
        free = np.ones((len(at_m), len(self._speeds_mps)), bool)
        for action, desired_mps in enumerate(self._speeds_mps):
            relative_mps = others_mps - desired_mps * heading[:, None]
            for time_s in np.linspace(0.0, self.threshold_s, _TIMES):
                then_m = at_m + time_s * relative_mps
                touches = np.abs((then_m * ahead).sum(axis=2)) < reach_m
                touches &= np.abs((then_m * aside).sum(axis=2)) < width_m
                free[:, action] &= ~(touches & in_question).any(axis=1)
        numbers = np.arange(len(self._speeds_mps))
        return np.asarray(np.where(free, numbers, 0).max(axis=1))
