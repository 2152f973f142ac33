"""The environments of egos among recorded vehicles, as ``gymnasium.make`` and ``make_vec`` make them."""

from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any

from gymnasium.vector import AutoresetMode

from tint_sumo.envs.entry_points import known_arguments
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.replay.cases import Ego
from tint_sumo.replay.scene import from_tracks
from tint_sumo.tracks.schema import Tracks

_NOT_HERE = ("scene", "p_conservative", "tau_s", "tracks")  # settings of scenes with drivers of their own
_OF_SCENE = [
    name for name, argument in signature(from_tracks).parameters.items() if argument.kind is argument.KEYWORD_ONLY
]


class ReplayEnv(SceneEnv):
    """Drive in the place of a recorded vehicle, among the others that were recorded.

    ## Description
    A SUMO network and a recording of its traffic: real tracks of any format that ``tint_sumo.tracks`` reads, or SUMO's
    floating-car data. The ego takes over the place, the speed and the route of a recorded vehicle, or begins on a way
    that is given. The others follow their recording, or, if they are reactive, do so until the ego matters to them.

    ### Not reactive
    The others are where they were recorded, whatever the ego does: SUMO's ``moveToXY`` places them at each step,
    between the recorded times by interpolation, with their sizes. They appear and vanish with their recording, and
    drive into an ego that is slower than the recorded vehicle was.

    ### Reactive
    A vehicle is released, and SUMO drives it from its present speed along its recorded route, if it would come within
    ``release_m`` of the ego in the next ``release_s`` seconds: it as it was recorded, the ego along its way at its
    present speed. If the ego would only come up to it from behind, it stays as recorded. Released vehicles count as the
    ego does: those behind one are released in turn when their recording would run into it. A released vehicle vanishes
    where its recording ends. It drives with the car-following model of ``drivers``; at junctions, SUMO's rules say who
    goes first, and those that ``yields`` says not to yield take no notice of the ego.

    ## Action Space, Observation Space, Rewards
    As in ``tint_sumo.envs.SceneEnv`` of a SUMO configuration. The desired speeds are nothing, half and all of the
    highest speed limit on the egos' routes, if ``controller`` says no others. Positions are those in a frame with the
    network's axes whose origin is at the ego's start.

    ## Starting State
    One of the cases. Each is an ego in the place of one recorded vehicle, from when that is first on an edge of the
    network, or, for an ``EgoOnEdges``, a time at which the ego has room at its start. The episode's seed draws the
    case; ``reset(options={"case": 3})`` chooses it by its number. The ego begins in the middle of its lane with the
    recorded speed.

    ## Episode End
    Termination: the ego passes its goal (``success``), which is 1 m before where the recorded vehicle was last on its
    route, or touches another vehicle (``collision``). Truncation: the time limit or the recording's end (``timeout``),
    or SUMO takes the ego off the road (``lost``).

    Faults of the recording, or between it and the network, are never the ego's outcome. Vehicles that touch the
    recorded vehicle in whose place the ego is, or that would appear on the ego, are left out. Vehicles that are on no
    lane, more than 1.5 m beyond its border, are neither seen nor touched while they are. Both are counted:

    ## Information
    As in ``tint_sumo.envs.SceneEnv``, ``traits`` being numbers in ``scene.vtypes``, the classes of the recording; and

    | Key            | Content                                                                                      |
    |----------------|----------------------------------------------------------------------------------------------|
    | `case`         | number of the episode's case                                                                 |
    | `released`     | vehicles released so far                                                                     |
    | `left_out`     | vehicles left out so far                                                                     |
    | `off_road`     | vehicles that are on no lane now                                                             |
    | `overlaps`     | pairs of recorded vehicles whose boxes have overlapped so far: collisions of the recording   |
    | `map_contacts` | vehicles on no lane that the ego's box has touched so far: faults of the map                 |
    | `collision`    | has `replayed`, too: whether the other vehicle followed its recording                        |

    ## Arguments
    * `net`: SUMO network (.net.xml) in the recording's coordinates.
    * `tracks`: file of the recording, or a ``tint_sumo.tracks.Tracks``. Infos with tracks of ``SceneEnv`` have
      ``SceneEnv(TaskSettings(from_tracks(net, tracks), tracks=True))``.
    * `ego`: name of a recorded vehicle, or several, in whose place the ego can be; ``EgoOnEdges(edges, start_m, goal_m,
      every_s=5.0, speed_mps=0.0)`` for a way of your own; default: any car that drives 10 m or more.
    * `reactive`: whether vehicles are released; default True.
    * `drivers`: folder of a fit (``tint-sumo drivers fit``) of this recording: each released vehicle drives as it was
      fitted, those without a fit as the median driver. A ``tint_sumo.config.FittedDriver``: all drive with its
      parameters of the Intelligent Driver Model. Default: SUMO's default drivers.
    * `yields`: for names of recorded vehicles, whether they yield to the ego, such as traits that were inferred of
      them; default: all do.
    * `release_s`, `release_m`: 4 s and 0.5 m; see above.
    * `track_format`: format of the recording; default: recognised.
    * `shift_m`: x and y that are added to the recording's positions; geographic ones are projected as the network is.
    * `step_s`: step of the simulation; default 0.1 s.
    * `max_vehicles`, `sight_m`, `controller`, `ego_control`, `perceives`, `red_light`, `red_light_penalty`: as in
      ``tint_sumo.scenes.from_sumocfg``.
    * `reward`, `time_limit_s`, `max_episode_steps`, `sensor`, `position_noise_m`, `decision_s`, `backend`,
      `render_mode`: as in ``tint_sumo.envs.SceneEnv``.

    ## Version History
    * v0: first release.
    """

    def __init__(
        self,
        net: str | Path,
        tracks: str | Path | Tracks,
        ego: Ego = None,
        render_mode: str | None = None,
        **more: Any,
    ) -> None:
        super().__init__(_settings(ReplayEnv, net, tracks, ego, more), render_mode)


class ReplayVectorEnv(SceneVectorEnv):
    """A vector of ``ReplayEnv``, each in a process of its own."""

    def __init__(
        self,
        net: str | Path,
        tracks: str | Path | Tracks,
        ego: Ego = None,
        num_envs: int = 1,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **more: Any,
    ) -> None:
        settings = _settings(ReplayVectorEnv, net, tracks, ego, more)
        super().__init__(num_envs, settings, render_mode, num_envs, autoreset_mode)


def _settings(
    entry_point: type, net: str | Path, tracks: str | Path | Tracks, ego: Ego, more: Mapping[str, Any]
) -> TaskSettings:
    """Return the settings of an environment; InputError if there is no argument of some name."""
    given = known_arguments(entry_point, more, _OF_SCENE, _NOT_HERE)
    of_scene = {name: given.pop(name) for name in _OF_SCENE if name in given}
    return TaskSettings(from_tracks(net, tracks, ego, **of_scene), **given)
