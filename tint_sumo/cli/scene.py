"""``tint-sumo scene``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import Command, Outcome, wrote
from tint_sumo.cli.values import EGO_ROUTE_HELP, PERCEIVES, RED_LIGHT, edges_of, optional
from tint_sumo.config import Perceivable, RedLight, RouteM
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import PICTURE_SUFFIXES, require_output_file
from tint_sumo.core.structures import Many

_EGO_ROUTE = optional("EDGE [EDGE ...]", f"{EGO_ROUTE_HELP}; with --goal-m.", "some are suggested")
_START = optional("FLOAT", "Position of the ego's front on its route at the beginning, m.", "0")
_GOAL = optional("FLOAT", "Position on its route at which the ego has arrived, m.")


@dataclass(frozen=True, kw_only=True)
class CheckScene(Command):
    """Say what is in a SUMO configuration, run its first 100 s, and suggest or check routes of the ego."""

    sumocfg: Positional[Path]
    """SUMO configuration (.sumocfg)."""
    ego_route: Annotated[Many[str] | None, _EGO_ROUTE] = None
    start_m: Annotated[RouteM | None, _START] = None
    goal_m: Annotated[RouteM | None, _GOAL] = None
    perceives: Annotated[Many[Perceivable] | None, PERCEIVES] = None
    red_light: Annotated[RedLight | None, RED_LIGHT] = None
    figure: Annotated[Path | None, optional("FILE", "Picture to write: .png, .jpg, .webp, .svg or .pdf.")] = None

    def run(self) -> Outcome:
        from tint_sumo.scenes import from_sumocfg
        from tint_sumo.simulation.sumocfg_check import check_sumocfg, report
        from tint_sumo.simulation.sumocfg_figure import plot_check

        if self.figure is not None:
            require_output_file(self.figure, PICTURE_SUFFIXES, "figure")
        scene = None
        if self.ego_route is not None:
            if self.goal_m is None:
                raise InputError("--ego-route needs --goal-m, the position at which the ego has arrived; add it")
            scene = from_sumocfg(
                self.sumocfg,
                edges_of(self.ego_route),
                self.start_m or 0.0,
                self.goal_m,
                perceives=self.perceives or (),
                red_light=self.red_light or "ignore",
            )
        elif self.start_m is not None or self.goal_m is not None:
            raise InputError("--start-m and --goal-m are positions on --ego-route; add it")
        elif self.perceives is not None or self.red_light is not None:
            raise InputError("--perceives and --red-light are the ego's; add its --ego-route and --goal-m")
        found = check_sumocfg(self.sumocfg, scene)
        text = report(found)
        if self.figure is not None:
            plot_check(found, self.figure)
            text = "\n".join([text, *wrote([str(self.figure)])])
        return Outcome(text, found.summary())


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Scene:
    """Scenes that SUMO configurations make."""

    command: Annotated[CheckScene, subcommand("check")] | Suppress[None]
