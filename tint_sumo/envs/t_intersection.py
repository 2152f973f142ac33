"""The single environment."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import Backend, Idm, Share
from tint_sumo.envs.episodes import Episodes, TaskSettings, action_space, observation_space, require_actions
from tint_sumo.envs.rendering import RENDER_FPS, render_intersection, require_render_mode
from tint_sumo.envs.rows import OBSERVATION_KEYS, OUTCOMES, REWARD_TERMS, ROW, Observation


class TIntersectionEnv(gymnasium.Env[Any, Any]):
    """Turn right across one lane and merge into the other, among drivers whose traits are unknown.

    ## Description
    An uncontrolled T-intersection with left-hand traffic (Liu et al., ICRA 2022), simulated by Eclipse SUMO. The ego
    comes up the stem, crosses the lower lane (westbound) and merges into the upper lane (eastbound). Conservative
    drivers yield to an ego that moves into their lane while they can still stop clear of its way; aggressive
    drivers do not and hit it. The ego's path is fixed; the agent chooses its desired speed, which a PD controller
    follows and a safety check can override.

    ## Action Space
    `Discrete(3)`: desired speed 0, 0.5 or 3 m/s.

    ## Observation Space
    A `Dict` of float32 arrays, lengths divided by 20 m, speeds by 3 m/s, clipped to [-2, 2]:

    | Key        | Shape     | Content                                                                          |
    |------------|-----------|----------------------------------------------------------------------------------|
    | `ego`      | `(4,)`    | x, y, x velocity, y velocity of the ego's centre; origin at the lower lane's edge |
    | `vehicles` | `(12, 2)` | x, y of each vehicle's centre minus the ego's, with noise; 0 in empty slots    |
    | `mask`     | `(12,)`   | 1 where the slot holds a vehicle                                                 |

    A vehicle keeps its slot for as long as it is on the street; a slot stays empty for at least one step between two
    vehicles. The others' velocities and traits are not observed.

    ## Rewards
    The sum of named terms, also found in `info["reward_terms"]`:

    | Term        | Paper                             | `reward="authors"`                |
    |-------------|-----------------------------------|-----------------------------------|
    | `goal`      | 2.5 at the goal                   | 2.5                               |
    | `collision` | -2 on collision                   | -2                                |
    | `speed`     | 0.05 x ego speed (m/s) otherwise  | 0.05 / 3 x ego speed otherwise    |
    | `step`      | -0.0013 otherwise                 | -0.013 otherwise                  |

    ## Starting State
    The ego stands with its centre at (0, -5). Both lanes are filled at random; each driver is conservative with
    probability `p_conservative`.

    ## Episode End
    Termination: the ego's centre passes x = 8 m on the upper lane (`success`), or its box touches another vehicle's
    (`collision`). Truncation: the time limit (`timeout`).

    ## Information
    | Key            | Content                                                                        |
    |----------------|--------------------------------------------------------------------------------|
    | `traits`       | `(12,)` int8, true traits: 1 conservative, -1 aggressive, 0 in empty slots     |
    | `outcome`      | `"success"`, `"collision"`, `"timeout"`, or `""` while the episode goes on     |
    | `reward_terms` | the reward's named terms (after a step)                                        |
    | `time_s`       | time since the episode's start                                                 |
    | `collision`    | after a collision: the other driver's `trait`, `lane`, `slot`, and `ego_m`     |

    ## Arguments
    * `p_conservative`: probability that a driver is conservative, in [0, 1]; default 0.4. Two numbers are a range, from
      which each episode draws its probability uniformly, by its seed.
    * `reward`: `"paper"` (default) or `"authors"` (the values of the authors' code).
    * `time_limit_s`: default 50 s.
    * `position_noise_m`: standard deviation of the noise on the others' x and y, independent per vehicle and step.
    * `tau_s`: time headway of the others' car following (SUMO's `tau`); default 1 s.
    * `backend`: `"libsumo"`, `"traci"` (a sumo subprocess), or `"auto"` (default): libsumo if no other environment of
      this process uses it, since libsumo holds one simulation per process.
    * `render_mode`: `None` or `"rgb_array"`.

    ## Version History
    * v1: a conservative driver that can no longer stop clear of the ego's way drives on. Before, it braked and stood so
      close that the ego's safety check held the ego: both waited until the time limit, in up to 28 % of the episodes.
      `p_conservative` takes a range; new argument `tau_s`.
    * v0: first release.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}  # noqa: RUF012 - gymnasium's way

    def __init__(
        self,
        p_conservative: Share = 0.4,
        reward: str = "paper",
        time_limit_s: float = 50.0,
        position_noise_m: float = 0.0,
        tau_s: float = Idm.tau_s,
        backend: Backend = "auto",
        render_mode: str | None = None,
    ) -> None:
        require_render_mode(render_mode)
        self.render_mode = render_mode
        self.observation_space = observation_space()
        self._episodes = Episodes(
            1, TaskSettings(p_conservative, reward, time_limit_s, position_noise_m, tau_s, backend)
        )
        self.action_space = action_space()

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002 - gymnasium's signature; there are none
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._episodes.begin(0, self.np_random)
        told = self._told()
        return _observation(told), _info(told)

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        actions = np.array([action])
        require_actions(actions, 1)
        self._episodes.step(actions)
        told = self._told()
        info = _info(told)
        info["reward_terms"] = {term: told[term] for term in REWARD_TERMS}
        if info["outcome"] == "collision":
            info["collision"] = self._episodes.collision_info(0)
        return _observation(told), told["reward"], told["terminated"], told["truncated"], info

    def _told(self) -> dict[str, Any]:
        """The row's fields as Python's numbers, and arrays that the next step overwrites."""
        return dict(zip(ROW.names or (), self._episodes.rows.item(), strict=True))

    def render(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) image of the intersection; conservative drivers blue, aggressive red, the ego yellow."""
        if self.render_mode is None:
            return None
        return render_intersection(self._episodes.simulation, 0)

    def close(self) -> None:
        self._episodes.simulation.close()


def _observation(told: dict[str, Any]) -> Observation:
    return {key: told[key].copy() for key in OBSERVATION_KEYS}


def _info(told: dict[str, Any]) -> dict[str, Any]:
    return {"traits": told["traits"].copy(), "outcome": OUTCOMES[told["outcome"]], "time_s": told["time_s"]}
