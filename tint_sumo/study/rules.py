"""Hand-written policies. They see what a learned policy sees, the observation, and never ``info``."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import POSITION_SCALE_M, SPEED_SCALE_MPS, EpisodeRules, Street, VehicleShape
from tint_sumo.policy.tracks import is_upper

Observation = dict[str, NDArray[np.float32]]
State = tuple[NDArray[np.float64], ...]

STOP, CREEP, GO = 0, 1, 2  # actions: desired speeds of 0, 0.5 and 3 m/s

LOWER_EDGE_Y_M = Street.lower_y_m - Street.lane_width_m / 2  # where the stem ends

_HALF_LENGTH_M = VehicleShape.length_m / 2


class AlwaysGo:
    """Drives at full speed whatever comes."""

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,  # noqa: ARG002
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[NDArray[np.int64], State | None]:
        """Actions (N,) for N observations; arguments and result as in Stable-Baselines3's ``predict``."""
        return np.full(len(observation["ego"]), GO), state


@dataclass(frozen=True)
class TimeToCollision:
    """Goes when no vehicle will soon be in its way, each driving on at its present speed.

    The rule of Cosgun et al. (Towards full automated drive in urban environments, 2017), the baseline of Isele et al.
    (Navigating occluded intersections with autonomous vehicles using deep reinforcement learning, 2018): the ego waits
    before a lane until, in every lane that it still has to cross, the next vehicle needs longer than a threshold to
    reach the conflict zone around the ego's path. It crosses the lower lane without a halt and looks again before the
    upper one. Speeds come from the positions of the last two observations; a vehicle just seen is taken to drive at
    3 m/s. A vehicle in the zone has time 0, a standing one an infinite time, and so has one whose centre is past the
    path: it is gone before the ego arrives.

    The default threshold is the best of 0.5 to 2 s at P(conservative) 0.4, on seeds that are no cases of an evaluation.
    With 2 s the ego never goes: traffic this dense has no such gap.
    """

    threshold_s: float = 1.2
    path_x_m: tuple[float, float] = (0.0, 2.0)  # where the ego's path meets the lower and the upper lane
    zone_margin_m: float = 1.0  # the zone begins this far before the path
    stop_lines_y_m: tuple[float, float] = (-0.5, 3.5)  # of the ego's front, before the lower and the upper lane

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[NDArray[np.int64], State]:
        """Actions (N,) for N observations; arguments and result as in Stable-Baselines3's ``predict``.

        The state holds what was seen last: x (m) and presence of each slot's vehicle, both (N, 12).
        """
        ego_m = observation["ego"][:, :2].astype(np.float64) * POSITION_SCALE_M
        centre_m = observation["vehicles"] * POSITION_SCALE_M + ego_m[:, None]
        x_m, upper = centre_m[..., 0], is_upper(centre_m[..., 1])
        present = observation["mask"] > 0.5
        speed_mps = speeds_mps(x_m, present, upper, state, episode_start)
        blocking = present & (self.times_s(x_m, upper, speed_mps) <= self.threshold_s)
        lower_free, upper_free = ~(blocking & ~upper).any(axis=1), ~(blocking & upper).any(axis=1)

        front_y_m = ego_m[:, 1] + _HALF_LENGTH_M  # exact on the stem, a good guess in the turn
        lower_line_m, upper_line_m = self.stop_lines_y_m
        before_lower = front_y_m < LOWER_EDGE_Y_M
        on_lower = ~before_lower & (front_y_m < upper_line_m)
        go = on_lower | (upper_free & (lower_free | ~before_lower))
        wait = np.where(front_y_m < lower_line_m, CREEP, STOP)
        return np.where(go, GO, wait), (x_m, present.astype(np.float64))

    def times_s(
        self, x_m: NDArray[np.float64], upper: NDArray[np.bool_], speed_mps: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Time until each vehicle reaches the conflict zone of its lane, from its centre, lane and speed."""
        before_path_m = np.where(upper, self.path_x_m[1] - x_m, x_m - self.path_x_m[0])
        to_zone_m = np.maximum(before_path_m - _HALF_LENGTH_M - self.zone_margin_m, 0.0)
        reach_s = np.full(x_m.shape, np.inf)
        np.divide(to_zone_m, speed_mps, out=reach_s, where=speed_mps > 0.0)
        return np.select([before_path_m < 0.0, to_zone_m == 0.0], [np.inf, 0.0], reach_s)


def speeds_mps(
    x_m: NDArray[np.float64],
    present: NDArray[np.bool_],
    upper: NDArray[np.bool_],
    state: State | None,
    episode_start: NDArray[np.bool_] | None,
) -> NDArray[np.float64]:
    """Speeds along the lane, (N, 12); the ego's top speed for vehicles not seen at the step before."""
    if state is None:
        return np.full(x_m.shape, SPEED_SCALE_MPS)
    previous_x_m, was_present = state
    seen = present & (was_present > 0.5)
    if episode_start is not None:
        seen &= ~episode_start[:, None]
    moved_m = np.where(upper, x_m - previous_x_m, previous_x_m - x_m)
    return np.where(seen, moved_m / EpisodeRules.step_s, SPEED_SCALE_MPS)
