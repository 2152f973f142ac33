"""A scene from a SUMO network and recorded tracks."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from tint_sumo.config import STEP_S, EgoControl, EgoController, FittedDriver, Perceivable, RedLight, StepS
from tint_sumo.core.errors import InputError, shown
from tint_sumo.drivers.fitted import Fitted
from tint_sumo.replay.cases import Ego, find_cases
from tint_sumo.replay.drivers import AnyDrivers, attributes_of, find_drivers, types_xml
from tint_sumo.replay.recordings import read_recordings, vehicle_classes
from tint_sumo.replay.routes import Routes
from tint_sumo.scenes.replay import Recording, ReplayCase, ReplayScene
from tint_sumo.scenes.scene import require_whole_milliseconds
from tint_sumo.scenes.sumo_config import SumoConfig
from tint_sumo.scenes.sumo_run import require_loads
from tint_sumo.scenes.sumocfg import SumocfgScene, controller_up_to, read_net, sight_of
from tint_sumo.tracks.reading import read_tracks
from tint_sumo.tracks.schema import Tracks


def from_tracks(
    net: str | Path,
    tracks: str | Path | Tracks,
    ego: Ego = None,
    *,
    reactive: bool = ReplayScene.reactive,
    drivers: AnyDrivers = None,
    yields: Mapping[str, bool] | None = None,
    track_format: str | None = None,
    shift_m: Sequence[float] = (0.0, 0.0),
    release_s: float = ReplayScene.release_s,
    release_m: float = ReplayScene.release_m,
    step_s: float = STEP_S,
    max_vehicles: int = SumocfgScene.max_vehicles,
    sight_m: float | None = None,
    controller: EgoController | None = None,
    ego_control: EgoControl = SumocfgScene.ego_control,
    perceives: Sequence[Perceivable] = SumocfgScene.perceives,
    red_light: RedLight = SumocfgScene.red_light,
    red_light_penalty: float = SumocfgScene.red_light_penalty,
) -> ReplayScene:
    """Return a scene of a network with recorded vehicles; ``tint_sumo.replay.ReplayEnv`` describes the arguments.

    Raises:
        InputError: files are missing or damaged, the tracks do not lie on the network, there is no such vehicle, or
            the ego has no way.
    """
    _require_arguments(net, tracks, reactive, yields, step_s)
    _require_shift(shift_m)
    network = read_net(Path(net))
    recorded = tracks if isinstance(tracks, Tracks) else read_tracks(Path(tracks), track_format)
    routes, labels, who = Routes(network), vehicle_classes(recorded), find_drivers(drivers)
    placed = read_recordings(recorded, Path(net), shift_m, routes, step_s, labels, yields or {})
    cases = find_cases(ego, placed, routes, step_s, labels)
    recordings = tuple(_with_drivers(one.recording, who, routes) for one in placed)
    options = (("net-file", str(Path(net).absolute())), ("step-length", f"{step_s:g}"), ("time-to-teleport", "-1"))
    config = SumoConfig(Path(net).absolute(), options, ())
    require_loads(config)
    driven = controller or controller_up_to(max(routes.limit_mps(case.route) for case in cases))
    if yields and not any(name in recording.vehicles for recording in recordings for name in yields):
        raise InputError(f"yields names none of the recorded vehicles, but {next(iter(yields))!r}; use their names")
    return ReplayScene(
        name=recorded.file.name.partition(".")[0],
        config=config,
        vtypes=labels,
        **ReplayScene.task_of(cases[0]),
        max_vehicles=max_vehicles,
        sight_m=sight_of(driven) if sight_m is None else sight_m,
        warm_up_s=0.0,
        controller=driven,
        ego_control=ego_control,
        perceives=tuple(perceives),
        red_light=red_light,
        red_light_penalty=red_light_penalty,
        recordings=recordings,
        cases=cases,
        recorded_digest=_digest(recordings, cases),
        types_xml=types_xml(labels, who),
        reactive=reactive,
        release_s=release_s,
        release_m=release_m,
        longest_way_m=max(case.goal_m - case.start_m for case in cases),
    )


def _with_drivers(recording: Recording, drivers: Fitted | FittedDriver | None, routes: Routes) -> Recording:
    limits_mps = np.array([routes.limit_mps(route) for route in recording.routes])
    return replace(recording, attributes=attributes_of(drivers, recording, limits_mps))


def _require_arguments(net: Any, tracks: Any, reactive: Any, yields: Any, step_s: Any) -> None:
    """Raise InputError if an argument is something else than it should be."""
    for name, value, kinds, wanted in (
        ("net", net, str | Path, "the file of a SUMO network"),
        ("tracks", tracks, str | Path | Tracks, "a file of tracks, or Tracks"),
        ("reactive", reactive, bool, "True or False"),
        ("yields", yields, Mapping | None, "a mapping of names of vehicles to True or False"),
    ):
        if not isinstance(value, kinds):
            raise InputError(f"{name} must be {wanted}, not {shown(value)}")
    get_args(StepS)[1].require("step_s", step_s)
    require_whole_milliseconds(step_s)


def _require_shift(shift_m: Any) -> None:
    """Raise InputError unless a shift consists of two finite numbers."""
    try:
        are_two = np.shape(shift_m) == (2,) and bool(np.isfinite(shift_m).all())
    except (TypeError, ValueError):  # no numbers
        are_two = False
    if not are_two:
        raise InputError(f"shift_m must be two numbers, added to x and y in m, not {shown(shift_m)}")


def _digest(recordings: Sequence[Recording], cases: Sequence[ReplayCase]) -> str:
    """Return a checksum of all on which episodes depend, but for the network."""
    whole = hashlib.sha256()
    for one in recordings:
        for array in (one.first_step, one.rows, one.box, one.speed_mps, one.on_road):
            whole.update(np.ascontiguousarray(array).tobytes())
        whole.update(repr((one.name, one.labels, one.routes, one.attributes, one.yields)).encode())
    for case in cases:
        whole.update(repr((case.recording, case.track, case.step, case.route, case.start_m, case.goal_m)).encode())
    return whole.hexdigest()[:16]
