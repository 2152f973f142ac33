"""Scenes made from a recording on a network: recorded vehicles in place of a demand, and an ego among them.

``tint_sumo.replay`` makes one from tracks. All times are counted in steps of the scene from the recording's begin.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self

from tint_sumo.config import OBSERVATION_BOUND, POSITION_SCALE_M, VehicleShape
from tint_sumo.core.ranges import Range, require_ranges
from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.sumocfg import SumocfgScene

NO_TRACK = -1  # number of the ego's track where it is nobody's


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded vehicles: N tracks with R rows in all, one at each step, the rows of a track one after the other."""

    name: str
    steps: int  # number of the last step
    vehicles: tuple[str, ...]  # N names; a vehicle that was lost for a while has several tracks
    labels: tuple[int, ...]  # N numbers among the scene's ``vtypes``
    routes: tuple[tuple[str, ...], ...]  # N routes of edges; empty where a vehicle is on none of them
    attributes: tuple[Mapping[str, float], ...]  # N sets of attributes of the vTypes with which they drive on
    drives_on: Bools  # (N,) whether it can be released: not on foot
    yields: tuple[bool, ...]  # N: whether they yield to the ego as SUMO's drivers do
    first_row: Numbers  # (N,)
    first_step: Numbers  # (N,)
    rows: Numbers  # (N,)
    box: Boxes  # (R,) in the network's frame
    speed_mps: Floats  # (R,)
    driven_m: Floats  # (R,) since the track's begin
    on_road: Bools  # (R,) whether the vehicle is on a lane
    keeps_route: Bools  # (N,) whether it is on its route wherever it is on a lane


@dataclass(frozen=True, eq=False)
class Way:
    """The way that the ego is expected to take."""

    box: Boxes  # (P,)
    driven_m: Floats  # (P,) from the ego's start


@dataclass(frozen=True, eq=False)
class ReplayCase:
    """An ego in a recording."""

    recording: int  # number
    track: int  # number of the recorded vehicle in whose place the ego is; NO_TRACK if in nobody's
    left_out: tuple[int, ...]  # numbers of tracks that are at the same place as the ego
    step: int  # at which it begins
    route: tuple[str, ...]
    route_edge_start_m: tuple[float, ...]
    start_m: float
    goal_m: float
    lane: str  # at the start, with the position of the ego's front there
    lane_m: float
    speed_mps: float
    vehicle: VehicleShape
    way: Way


@dataclass(frozen=True)
class ReplayScene(SumocfgScene):
    """A network with recorded vehicles, and the ego's task in each of its cases.

    ``config`` names the network alone. ``ego_route``, ``start_m``, ``goal_m`` and ``vehicle`` are those of the first
    case; ``of`` returns the scene of another one.
    """

    recordings: tuple[Recording, ...] = field(default=(), repr=False)
    cases: tuple[ReplayCase, ...] = field(default=(), repr=False)
    recorded_digest: str = ""  # of recordings and cases
    types_xml: str = ""  # one vType for each label
    reactive: bool = True
    release_s: Annotated[float, Range(0.0, 30.0)] = 4.0  # recorded vehicles look so far ahead for the ego
    release_m: Annotated[float, Range(0.0, 20.0)] = 0.5  # and are released if they would come so near to it
    longest_way_m: float = 1.0  # over all cases
    case: int = 0  # the number of this one

    def __post_init__(self) -> None:
        super().__post_init__()
        require_ranges(self)

    def of(self, case: int) -> Self:
        """Return the scene of a case, in which an episode ends with the recording."""
        chosen = self.cases[case]
        left_s = (self.recordings[chosen.recording].steps - chosen.step) * self.step_s
        return replace(self, **self.task_of(chosen), case=case, time_limit_s=min(self.time_limit_s, left_s))

    @staticmethod
    def task_of(case: ReplayCase) -> dict[str, Any]:
        """Return the fields of a scene that say the ego's task."""
        return {
            "ego_route": case.route,
            "route_edge_start_m": case.route_edge_start_m,
            "start_m": case.start_m,
            "goal_m": case.goal_m,
            "vehicle": case.vehicle,
        }

    @property
    def recording(self) -> Recording:
        """The recording of this case."""
        return self.recordings[self.cases[self.case].recording]

    @property
    def added_types_xml(self) -> str:
        return self.types_xml

    @property
    def digest(self) -> str:
        return f"{self.config.digest[:8]}{self.recorded_digest[:8]}"

    @property
    def ego_scale_m(self) -> float:
        """The same for all cases, or the same numbers would mean different positions to a policy."""
        return max(POSITION_SCALE_M, self.longest_way_m / OBSERVATION_BOUND)
