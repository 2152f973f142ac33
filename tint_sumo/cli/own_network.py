"""Flags of commands that drive in a scene, or in a SUMO configuration."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tint_sumo.cli.command import Command, flag_of
from tint_sumo.cli.values import EGO_ROUTE_HELP, PERCEIVES, RED_LIGHT, edges_of, optional
from tint_sumo.config import EgoController, Perceivable, RedLight, RouteM, SpeedMps, TimeS, WarmStarts, WarmUpS
from tint_sumo.core.errors import InputError
from tint_sumo.core.structures import Many

_SUMOCFG = optional("FILE", "SUMO configuration in place of a scene: its network, its demand, its vTypes as labels.")
_ROUTE = optional("EDGE [EDGE ...]", f"{EGO_ROUTE_HELP}; with --sumocfg.")
_START = optional("FLOAT", "Start of the ego's front on its route, m; with --sumocfg.", "0")
_GOAL = optional("FLOAT", "The ego's front past it on its route, m, is a success; with --sumocfg.")
_SPEEDS = optional(
    "FLOAT FLOAT [...]",
    "Desired speeds that the policy chooses from, m/s, rising; with --sumocfg.",
    "nothing, half and all of the highest speed limit on the route",
)
_WARM_UP = optional("FLOAT", "Time for which the traffic runs before the ego appears, s; with --sumocfg.", "30")
_SPREAD = optional("FLOAT", "Each episode draws by how much longer that is, s, from 0 to this; with --sumocfg.", "0")
_WARM_STARTS = optional(
    "INT",
    "With --sumocfg, the traffic of so many seeds is warmed up once each for all episodes of a training; tests warm up "
    "for each case.",
    "0, each episode has its own",
)
_TIME_LIMIT = optional("FLOAT", "Longest time of an episode, s; with --sumocfg.", "50")
_TASK = (
    *("ego_route", "start_m", "goal_m", "speeds_mps", "warm_up_s", "warm_up_spread_s", "warm_starts"),
    *("time_limit_s", "perceives", "red_light"),
)


@dataclass(frozen=True, kw_only=True)
class NetworkCommand(Command):
    """Base class of these commands. More settings of the ego's task can be given as a scene in a file."""

    sumocfg: Annotated[Path | None, _SUMOCFG] = None
    ego_route: Annotated[Many[str] | None, _ROUTE] = None
    start_m: Annotated[RouteM | None, _START] = None
    goal_m: Annotated[RouteM | None, _GOAL] = None
    speeds_mps: Annotated[Many[SpeedMps] | None, _SPEEDS] = None
    warm_up_s: Annotated[WarmUpS | None, _WARM_UP] = None
    warm_up_spread_s: Annotated[WarmUpS | None, _SPREAD] = None
    warm_starts: Annotated[WarmStarts | None, _WARM_STARTS] = None
    time_limit_s: Annotated[TimeS | None, _TIME_LIMIT] = None
    perceives: Annotated[Many[Perceivable] | None, PERCEIVES] = None
    red_light: Annotated[RedLight | None, RED_LIGHT] = None

    def scene_of(self, scene: Any) -> Any:
        """Return the scene of --sumocfg and the flags that go with it; otherwise the value of --scene.

        Raises:
            InputError: flags are missing, or do not go together.
        """
        given = {name: getattr(self, name) for name in _TASK if getattr(self, name) is not None}
        if self.sumocfg is None:
            if given:
                raise InputError(f"{flag_of(next(iter(given)))} goes with --sumocfg; give that, or leave it out")
            return scene
        if scene != getattr(type(self), "scene"):  # noqa: B009 - subclasses have it
            raise InputError("--scene does not go with --sumocfg, which is the scene; leave one of them out")
        missing = [flag_of(name) for name in ("ego_route", "goal_m") if name not in given]
        if missing:
            raise InputError(f"--sumocfg needs {' and '.join(missing)}: the ego's task in that network")
        from tint_sumo.scenes import from_sumocfg

        given["ego_route"] = edges_of(given["ego_route"])
        if "speeds_mps" in given:
            given["controller"] = EgoController(given.pop("speeds_mps"))
        return from_sumocfg(self.sumocfg, **{"start_m": 0.0, **given})
