"""Scenes made from any SUMO configuration, with its network and demand, through which the ego is driven.

The drivers are those of the configuration, and so are the rules by which they meet the ego: SUMO's. Whoever wants to
learn their traits takes their vTypes for labels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Self, get_args
from xml.sax import SAXException

import shapely
import sumolib

from tint_sumo.config import (
    OBSERVATION_BOUND,
    POSITION_SCALE_M,
    SPEED_SCALE_MPS,
    DistanceM,
    EgoControl,
    EgoController,
    Penalty,
    Perceivable,
    RedLight,
    Slots,
    TimeS,
    VehicleShape,
    WarmStarts,
    WarmUpS,
)
from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import require_ranges
from tint_sumo.core.reading import TABLE_BYTES, require_file
from tint_sumo.scenes.roads import Roads, crossing_marks, paved_areas
from tint_sumo.scenes.scene import EgoTask
from tint_sumo.scenes.sumo_config import SumoConfig, read_config, read_vtypes
from tint_sumo.scenes.sumo_run import require_loads

NET_VERSION = (1, 20)  # the version that this SUMO's netconvert writes into networks
EGO_CLASS = "passenger"
_COLOURS = ((40, 90, 200), (200, 40, 40), (30, 140, 70), (130, 60, 170), (220, 110, 20), (20, 150, 170), (90, 90, 90))
_SIGHT_S = 5.0  # the ego sees as far as it drives in this time
_SEAM_M = 0.06  # half of the line between two lanes


@dataclass(frozen=True)
class SumocfgScene:
    """A SUMO configuration and the ego's task in it; ``from_sumocfg`` makes one.

    Lengths along the ego's route are those that SUMO's odometer shows, lanes on junctions included. Vehicles are seen
    up to ``sight_m`` away, the nearest ``max_vehicles`` of them.
    """

    base: ClassVar[str] = ""  # no built-in scene with other numbers
    tau_s: ClassVar[None] = None  # the vTypes say it
    speed_limit_mps: ClassVar[float] = math.inf  # not known

    name: str
    config: SumoConfig
    vtypes: tuple[str, ...]  # the labels: ids of all vTypes of vehicles, sorted
    ego_route: tuple[str, ...]
    start_m: float
    goal_m: float
    route_edge_start_m: tuple[float, ...]  # start of each edge along the route
    max_vehicles: Slots = 12
    sight_m: DistanceM = 50.0
    warm_up_s: WarmUpS = 30.0  # the traffic runs for so long before the ego appears
    warm_up_spread_s: WarmUpS = 0.0  # and for up to so much longer, which each episode draws
    warm_starts: WarmStarts = 0  # so many states of the traffic are warmed up for all episodes; 0: each has its own
    time_limit_s: TimeS = 50.0
    vehicle: VehicleShape = field(default_factory=VehicleShape)
    controller: EgoController = field(default_factory=EgoController)
    ego_control: EgoControl = "speed"  # "sumo": SUMO's driver drives the ego, whatever the actions are
    perceives: tuple[Perceivable, ...] = ()  # further keys of the observation, in the order of ``Perceivable``
    red_light: RedLight = "ignore"  # consequence of driving over a stop line at red: none, a cost, the episode's end
    red_light_penalty: Penalty = 1.0  # is taken from the reward for each stop line driven over at red, with "cost"

    def __post_init__(self) -> None:
        require_ranges(self)
        for name, choices in (("ego_control", EgoControl), ("red_light", RedLight)):
            _require_choice(name, getattr(self, name), choices)
        object.__setattr__(self, "perceives", _in_order(self.perceives))

    @property
    def sumocfg(self) -> Path:
        """The SUMO configuration whose traffic it has."""
        return self.config.file

    @property
    def traits(self) -> tuple[str, ...]:
        """Names of the drivers' traits: their vTypes; labels are their numbers."""
        return self.vtypes

    @property
    def trait_colours(self) -> tuple[tuple[int, ...], ...]:
        """Red, green and blue of each vType in pictures; the colours begin again after some."""
        return tuple(_COLOURS[number % len(_COLOURS)] for number in range(len(self.vtypes)))

    def with_drivers(self, p_conservative: object, tau_s: object) -> Self:
        """Return the scene.

        Raises:
            InputError: either is given, but the vTypes and the demand of the configuration say who drives.
        """
        given = {"p_conservative": p_conservative, "tau_s": tau_s}
        names = [name for name, value in given.items() if value is not None]
        if names:
            raise InputError(f"the demand of a .sumocfg says who drives how; leave {' and '.join(names)} out")
        return self

    @property
    def step_s(self) -> float:
        return self.config.step_s

    @property
    def added_types_xml(self) -> str:
        """The vTypes that the configuration does not have."""
        return ""

    @property
    def digest(self) -> str:
        return self.config.digest

    @property
    def ego(self) -> EgoTask:
        return EgoTask(self.ego_route, self.start_m, self.goal_m, controller=self.controller)

    @property
    def speed_scale_mps(self) -> float:
        """Velocities are observed divided by this: the ego's top speed, if that is more than in the built-in scenes."""
        return max(SPEED_SCALE_MPS, self.controller.desired_speeds_mps[-1])

    @property
    def position_scale_m(self) -> float:
        """Positions of the others are observed divided by this, such that all in sight are within the bounds."""
        return max(POSITION_SCALE_M, self.sight_m / OBSERVATION_BOUND)

    @property
    def ego_scale_m(self) -> float:
        """The ego's position is observed divided by this, such that all of its way is within the bounds."""
        return max(POSITION_SCALE_M, (self.goal_m - self.start_m) / OBSERVATION_BOUND)

    @property
    def departure(self) -> tuple[tuple[str, ...], float]:
        """The edges that are left of the route where the ego starts, and its front's position on the first of them."""
        number = max(index for index, edge_m in enumerate(self.route_edge_start_m) if edge_m <= self.start_m)
        return self.ego_route[number:], self.start_m - self.route_edge_start_m[number]


def from_sumocfg(
    sumocfg: str | Path,
    ego_route: Sequence[str],
    start_m: float,
    goal_m: float,
    *,
    max_vehicles: int = SumocfgScene.max_vehicles,
    sight_m: float | None = None,
    warm_up_s: float = SumocfgScene.warm_up_s,
    warm_up_spread_s: float = SumocfgScene.warm_up_spread_s,
    warm_starts: int = SumocfgScene.warm_starts,
    time_limit_s: float = SumocfgScene.time_limit_s,
    vehicle: VehicleShape | None = None,
    controller: EgoController | None = None,
    ego_control: EgoControl = SumocfgScene.ego_control,
    perceives: Sequence[Perceivable] = SumocfgScene.perceives,
    red_light: RedLight = SumocfgScene.red_light,
    red_light_penalty: float = SumocfgScene.red_light_penalty,
) -> SumocfgScene:
    """Return a scene of the configuration's network and demand.

    Args:
        sumocfg: SUMO configuration; its step length is the scene's.
        ego_route: edges that the ego drives along, one after the other.
        start_m: position of the ego's front on its route at the beginning; not on a junction.
        goal_m: the ego's front past it is a success.
        max_vehicles: most vehicles in an observation, the nearest ones.
        sight_m: farthest distance at which they are observed; by default 50 m, or what the ego drives in 5 s at its
            highest desired speed if that is more.
        warm_up_s: time for which the traffic runs before the ego appears.
        warm_up_spread_s: each episode draws by how much longer than ``warm_up_s`` that is, from 0 to this. Where the
            demand has fixed times of departure, all episodes begin with nearly the same traffic without it.
        warm_starts: the traffic of so many seeds is warmed up once each, and an episode begins with one of them, which
            its seed chooses; it then goes on with random numbers of its own. 0: each episode has a warm-up of its own.
        time_limit_s: of an episode.
        vehicle: the ego's shape.
        controller: of the ego; its desired speeds are the actions. By default they are nothing, half and all of the
            highest speed limit on its route.
        ego_control: "sumo" lets SUMO's driver of a default passenger car drive the ego, up to its highest desired
            speed and the speed limit, as a baseline on the same cases: it obeys traffic lights and the right of way,
            keeps its distance, and takes no notice of actions.
        perceives: names of further keys of the observation, which ``tint_sumo.envs.SceneEnv`` describes:
            "traffic_light", "right_of_way", "speed_limit", "lane" and "pedestrians".
        red_light: consequence of the ego's front driving over a stop line while its signal is red. "ignore": none.
            "cost": the step's ``info["cost"]`` is the number of such lines, and the reward is lower by
            ``red_light_penalty`` for each. "end": the episode ends with the outcome ``red_light`` and the reward of a
            collision.
        red_light_penalty: taken from the reward for each such line with "cost".

    Raises:
        InputError: files are missing or of a newer SUMO, the route does not exist or is not connected, or the ego's
            start and goal are not on it, one behind the other.
    """
    config = read_config(Path(sumocfg))
    net = read_net(config.net_file)
    require_loads(config)
    edge_start_m, spans_m, length_m = measure_route(net, tuple(ego_route))
    require_on_route(start_m, goal_m, spans_m, length_m)
    driven = controller or controller_for(net, tuple(ego_route))
    return SumocfgScene(
        name=config.name,
        config=config,
        vtypes=read_vtypes(config),
        ego_route=tuple(ego_route),
        start_m=float(start_m),
        goal_m=float(goal_m),
        route_edge_start_m=edge_start_m,
        max_vehicles=max_vehicles,
        sight_m=sight_of(driven) if sight_m is None else sight_m,
        warm_up_s=warm_up_s,
        warm_up_spread_s=warm_up_spread_s,
        warm_starts=warm_starts,
        time_limit_s=time_limit_s,
        vehicle=vehicle or VehicleShape(),
        controller=driven,
        ego_control=ego_control,
        perceives=tuple(perceives),
        red_light=red_light,
        red_light_penalty=red_light_penalty,
    )


def _require_choice(name: str, value: Any, choices: Any) -> None:
    """Raise InputError unless a value is one of the words of a literal type."""
    if value not in get_args(choices):
        raise InputError(f"{name} must be one of {', '.join(get_args(choices))}, not {shown(value)}")


def _in_order(perceives: Any) -> tuple[Perceivable, ...]:
    """Return the names of keys in the order of ``Perceivable``.

    Raises:
        InputError: they are no names, or there is no such key.
    """
    if isinstance(perceives, str) or not isinstance(perceives, Sequence):
        raise InputError(f"perceives must be names such as ('traffic_light', 'lane'), not {shown(perceives)}")
    for name in perceives:
        _require_choice("perceives", name, Perceivable)
    return tuple(name for name in get_args(Perceivable) if name in perceives)


def controller_for(net: Any, edges: tuple[str, ...]) -> EgoController:
    """Return a controller with nothing, half and all of the highest speed limit on a route as desired speeds."""
    return controller_up_to(max(float(net.getEdge(edge).getSpeed()) for edge in edges))


def controller_up_to(limit_mps: float) -> EgoController:
    """Return a controller with nothing, half and all of a speed limit as desired speeds."""
    return EgoController((0.0, limit_mps / 2, limit_mps))


def sight_of(controller: EgoController) -> float:
    """Return how far an ego sees by default, in m: 50, or as far as it drives in 5 s if that is more."""
    return max(SumocfgScene.sight_m, _SIGHT_S * controller.desired_speeds_mps[-1])


def require_on_route(start_m: float, goal_m: float, spans_m: Sequence[tuple[float, float]], length_m: float) -> None:
    """Raise InputError unless an ego's start and goal are on its route, one behind the other.

    Args:
        start_m: of the ego's front.
        goal_m: of its front.
        spans_m: where the route's edges begin and end, between its junctions.
        length_m: of the route.
    """
    if not 0.0 <= start_m < goal_m <= length_m:
        raise InputError(
            f"the ego's start ({start_m:g} m) and goal ({goal_m:g} m) must lie on its route one behind the other, "
            f"from 0 to {length_m:.1f} m"
        )
    if not any(first_m <= start_m <= last_m for first_m, last_m in spans_m):
        ends = ", ".join(f"{first_m:.1f} to {last_m:.1f}" for first_m, last_m in spans_m)
        raise InputError(f"the ego's start ({start_m:g} m) is on a junction; its route's edges are at {ends} m")


def read_net(file: Path, *, with_internal: bool = True) -> Any:
    """Return a SUMO network, as sumolib reads it.

    Raises:
        InputError: there is no such file, it is no network, or one of a newer SUMO.
    """
    require_file(file, "SUMO network", TABLE_BYTES)
    try:
        net = sumolib.net.readNet(str(file), withInternal=with_internal)
    except (SAXException, ValueError, KeyError, OSError, EOFError) as error:
        raise InputError(f"{file} is not a SUMO network ({error}); give the scenario's .net.xml") from None
    version = net.getVersion()
    if version is None:
        raise InputError(f"{file} is not a SUMO network; give the scenario's .net.xml")
    if tuple(map(int, version)) > NET_VERSION:
        found, known = (".".join(str(int(part)) for part in numbers) for numbers in (version, NET_VERSION))
        raise InputError(
            f"{file} is a network of version {found}, which is of a newer SUMO than the one installed (up to {known}); "
            "build it again with this one's netconvert"
        )
    for edge in net.getEdges():
        for lane in edge.getLanes():
            _require_sound(lane, file)
    return net


def _require_sound(lane: Any, file: Path) -> None:
    """Raise InputError where a lane has no length or shape: libsumo would end this process."""
    shape = lane.getShape3D()
    numbers = (lane.getLength(), lane.getSpeed(), *(number for point in shape for number in point))
    if len(shape) < 2 or lane.getLength() <= 0.0 or not all(map(math.isfinite, numbers)):
        raise InputError(f"{file} is damaged: lane {lane.getID()!r} has no sound length, speed or shape; make it anew")


@lru_cache(maxsize=4)
def network_roads(net_file: Path) -> Roads:
    """Return the roads of a network, with its crossings; thin lines part their lanes."""
    net = read_net(net_file)
    paved = paved_areas(net, seam_m=_SEAM_M, gap_m=_SEAM_M)
    return Roads(shapely.STRtree(paved), shapely.STRtree(list(crossing_marks(net))))


def measure_route(net: Any, edges: tuple[str, ...]) -> tuple[tuple[float, ...], list[tuple[float, float]], float]:
    """Return the starts of a route's edges, their spans, and the route's length, in m along the route.

    Raises:
        InputError: the network lacks an edge, an edge is closed to passenger cars, or they are not connected.
    """
    if not edges:
        raise InputError("ego_route is empty; give the edges that the ego drives along")
    unknown = [edge for edge in edges if not net.hasEdge(edge)]
    if unknown:
        raise InputError(f"ego_route: the network has no edge {unknown[0]!r}")
    closed = [edge for edge in edges if not net.getEdge(edge).allows(EGO_CLASS)]
    if closed:
        raise InputError(f"ego_route: edge {closed[0]!r} is closed to passenger cars")
    lengths_m = [float(net.getEdge(edge).getLength()) for edge in edges]
    starts_m = [0.0]
    for (edge, after), length_m in zip(pairwise(edges), lengths_m, strict=False):
        starts_m.append(starts_m[-1] + length_m + _junction_m(net, edge, after))
    spans_m = [(start_m, start_m + length_m) for start_m, length_m in zip(starts_m, lengths_m, strict=True)]
    return tuple(starts_m), spans_m, spans_m[-1][1]


def _junction_m(net: Any, edge: str, after: str) -> float:
    """Return the length of the shortest way over the junction between two edges."""
    ways = [
        way
        for way in net.getEdge(edge).getOutgoing().get(net.getEdge(after), [])
        if way.getFromLane().allows(EGO_CLASS) and way.getToLane().allows(EGO_CLASS)
    ]
    if not ways:
        raise InputError(f"ego_route: no way for passenger cars leads from edge {edge!r} to edge {after!r}")
    path, length_m = net.getInternalPath(ways)
    return float(length_m) if path else 0.0  # a network can lack its junctions' lanes
