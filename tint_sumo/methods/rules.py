"""Hand-written policies. They see what a learned policy sees, the observation, and never ``info``."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tint_sumo.scenes import AnyScene, Scene, paper_scene, require_built_in
from tint_sumo.scenes.geometry import SPACING_M, Floats, along, as_line, new_boxes, place, project
from tint_sumo.scenes.layout import Layout, layout

Observation = dict[str, NDArray[np.float32]]
State = tuple[NDArray[np.float64], ...]

STOP, CREEP, GO = 0, 1, 2  # actions: desired speeds of 0, 0.5 and 3 m/s in the built-in scenes
ACTIONS = 3

_THRESHOLD_S = 1.2
_THRESHOLDS_S = {"t_intersection_street": 4.0}  # where the ego's way takes longer; 200 cases of set 1000


@dataclass(frozen=True)
class AlwaysGo:
    """Drives at full speed whatever comes."""

    action: int = GO  # number of the highest desired speed

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,  # noqa: ARG002
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[NDArray[np.int64], State | None]:
        """Return actions (N,) for N observations; arguments and result as in Stable-Baselines3's ``predict``."""
        return np.full(len(observation["ego"]), self.action), state


@dataclass(frozen=True)
class TimeToCollision:
    """Goes when no vehicle will soon be in its way, each driving on at its present speed.

    The rule of Cosgun et al. (Towards full automated drive in urban environments, 2017), the baseline of Isele et al.
    (Navigating occluded intersections with autonomous vehicles using deep reinforcement learning, 2018): the ego waits
    before a route until, on every route that it still has to cross, the next vehicle needs longer than a threshold to
    reach the conflict zone around the ego's path. It crosses one route without a halt and looks again before the next;
    in the vehicles' path it waits for nobody.
    Speeds come from the positions of the last two observations; a vehicle just seen is taken to drive at the ego's top
    speed. A vehicle in the zone has time 0, a standing one an infinite time, and so has one whose centre is past the
    ego's path: it is gone before the ego arrives.

    The default threshold is one of the best in the T-intersection at P(conservative) 0.4, on cases that are reported
    nowhere (set 1000, 300 cases): 0.8, 1.0, 1.2, 1.4 and 1.6 s succeed in 38, 50, 57, 60 and 58 %, and 2 s in 33 %:
    traffic this dense has few such gaps. Commands take 4 s in ``t_intersection_street``.
    """

    threshold_s: float = _THRESHOLD_S
    zone_margin_m: float = 1.0  # the zone begins this far before the ego's path
    line_margin_m: float = 0.5  # the ego waits this far before a route's lane
    scene: AnyScene = field(default_factory=paper_scene)

    @cached_property
    def _geometry(self) -> "_Geometry":
        scene = require_built_in("ttc", self.scene)
        return _Geometry(layout(scene))

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002
    ) -> tuple[NDArray[np.int64], State]:
        """Return actions (N,) for N observations; arguments and result as in Stable-Baselines3's ``predict``.

        The state holds what was seen last: the centre's distance along its route (m) and presence of each slot's
        vehicle, both (N, V).
        """
        geometry = self._geometry
        ego_m = observation["ego"][:, :2].astype(np.float64) * self.scene.position_scale_m
        centre_m = observation["vehicles"] * self.scene.position_scale_m + ego_m[:, None]
        present = observation["mask"] > 0.5
        route, along_m = geometry.on_routes(centre_m)
        new_mps = self.scene.speed_scale_mps
        speed_mps = speeds_mps(along_m, present, state, episode_start, geometry.step_s, new_mps)
        blocking = present & (self.times_s(route, along_m, speed_mps) <= self.threshold_s)

        front_m = geometry.ego_front_m(ego_m)[:, None]
        line_m = geometry.enter_m - self.line_margin_m
        next_line_m = np.r_[line_m[1:], np.inf]
        ahead = (front_m < next_line_m) & (front_m < geometry.inside_m)  # (N, K): routes the ego has yet to cross
        crossing = ((front_m >= geometry.enter_m) & (front_m < next_line_m))[:, :-1].any(axis=1)
        blocked = np.stack([(blocking & (route == number)).any(axis=1) for number in geometry.order], axis=1)
        go = crossing | ~(blocked & ahead).any(axis=1)
        wait = np.where(front_m[:, 0] < line_m[0], CREEP, STOP)
        return np.where(go, GO, wait), (along_m, present.astype(np.float64))

    def times_s(self, route: NDArray[np.int64], along_m: Floats, speed_mps: Floats) -> Floats:
        """Return the time until each vehicle reaches its route's conflict zone, from its centre's distance along it."""
        before_path_m = self._geometry.meet_m[route] - along_m
        to_zone_m = np.maximum(before_path_m - self._geometry.half_length_m - self.zone_margin_m, 0.0)
        reach_s = np.full(along_m.shape, np.inf)
        np.divide(to_zone_m, speed_mps, out=reach_s, where=speed_mps > 0.0)
        return np.select([before_path_m < 0.0, to_zone_m == 0.0], [np.inf, 0.0], reach_s)


def threshold_s(scene: Scene) -> float:
    """Return the threshold of ``TimeToCollision`` in a scene."""
    return _THRESHOLDS_S.get(scene.base or scene.name, _THRESHOLD_S)


class _Geometry:
    """Geometry of a scene for the rule, with the routes in the order in which the ego meets them."""

    def __init__(self, layout: Layout) -> None:
        zones, way = layout.zones, layout.ego.way
        self.half_length_m = layout.scene.vehicle.length_m / 2
        self.step_s = layout.scene.step_s
        self.order = np.argsort(zones.enter_m)
        self.enter_m, self.inside_m = zones.enter_m[self.order], zones.inside_m[self.order]
        self._lines = [as_line(path.way) for path in layout.routes]
        inside = way[(zones.inside_m / SPACING_M).astype(int)]  # the ego's front where it stands in the vehicles' path
        self.meet_m = np.array(
            [project(point[None], line)[0][0] for point, line in zip(inside, self._lines, strict=True)]
        )
        self._ego_fronts_m = along(way)
        vehicle = layout.scene.vehicle
        egos = new_boxes(len(way), vehicle.length_m, vehicle.width_m)
        place(self._ego_fronts_m, way, egos)
        centres = np.stack([egos["x_m"], egos["y_m"]], axis=-1)
        self._ego_line = as_line(centres)
        self._ego_centres_m = np.r_[0.0, np.cumsum(np.hypot(*np.diff(centres, axis=0).T))]

    def on_routes(self, centre_m: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the nearest route of each centre (N, V, 2), and its distance along it; both (N, V)."""
        points = centre_m.reshape(-1, 2)
        found = [project(points, line) for line in self._lines]
        nearest = np.argmin([off_m for _, off_m in found], axis=0)
        along_m = np.choose(nearest, [along_m for along_m, _ in found])
        return nearest.reshape(centre_m.shape[:2]), along_m.reshape(centre_m.shape[:2])

    def ego_front_m(self, ego_m: Floats) -> Floats:
        """Return the distances (N,) of the fronts of egos with these centres (N, 2) along their way, m."""
        along_m, _ = project(ego_m, self._ego_line)
        return np.asarray(np.interp(along_m, self._ego_centres_m, self._ego_fronts_m))


def speeds_mps(
    along_m: Floats,
    present: NDArray[np.bool_],
    state: State | None,
    episode_start: NDArray[np.bool_] | None,
    step_s: float,
    new_mps: float,
) -> Floats:
    """Return the speeds along the routes, (N, V); ``new_mps`` for vehicles not seen at the step before."""
    if state is None:
        return np.full(along_m.shape, new_mps)
    was_along_m, was_present = state
    seen = present & (was_present > 0.5)
    if episode_start is not None:
        seen &= ~episode_start[:, None]
    return np.where(seen, (along_m - was_along_m) / step_s, new_mps)
