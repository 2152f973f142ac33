"""Scenes from a network and tracks: what they take of a recording, and what they refuse."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.replay.recordings import LOWER_Y_M, UPPER_Y_M, Driven, built, recording
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.entry_points import env_spec
from tint_sumo.replay import EgoOnEdges, from_tracks
from tint_sumo.scenes import described

WEST = Driven("west", 90.0, LOWER_Y_M, -10.0)


def test_rows_are_interpolated_to_the_steps_of_the_scene(street: Path) -> None:
    scene = from_tracks(street, recording([replace(WEST, step_s=0.25)]))
    (one,) = scene.recordings
    assert one.steps == 150
    np.testing.assert_allclose(one.box["x_m"], 90.0 - np.arange(151) * 1.0)
    np.testing.assert_allclose(one.driven_m, np.arange(151) * 1.0)
    assert one.routes == (("lower_in.0", "lower_out.0"),)
    assert one.on_road.all()


def test_a_vehicle_is_not_there_while_it_was_lost(street: Path) -> None:
    parts = [replace(WEST, last_s=2.0).rows(), replace(WEST, x_m=40.0, first_s=5.0).rows()]
    (one,) = from_tracks(street, built([*parts, Driven("east", -90.0, UPPER_Y_M, 10.0).rows()])).recordings
    assert one.vehicles == ("east", "west", "west")
    assert one.first_step.tolist() == [0, 0, 50]


def test_routes_go_on_where_vehicles_turn(street: Path) -> None:
    """A vehicle from the south is on the stem, on both junctions, and on the upper lane then."""
    way = np.concatenate([np.stack([np.zeros(20), np.linspace(-15.0, 0.0, 20)], axis=1), _quarter_circle()])
    way = np.concatenate([way, np.stack([np.linspace(7.0, 60.0, 60), np.full(60, UPPER_Y_M)], axis=1)])
    heading = np.arctan2(*np.gradient(way, axis=0).T[::-1])
    shape = replace(WEST, name="turns", last_s=(len(way) - 1) * 0.1).rows()
    shape["x_m"], shape["y_m"], shape["heading_rad"] = way[:, 0], way[:, 1], heading
    scene = from_tracks(street, built([shape]))
    (one,) = scene.recordings
    assert one.routes == (("stem.0", "mid.0", "upper_out.0"),)
    assert one.on_road.all()
    (case,) = scene.cases
    assert case.start_m == pytest.approx(20.0 - 15.0 + 2.5, abs=0.1)
    assert case.goal_m - case.start_m == pytest.approx(np.hypot(*np.diff(way, axis=0).T).sum() - 1.0, abs=1.5)


def _quarter_circle() -> NDArray[np.float64]:
    angle = np.linspace(0.1, np.pi / 2, 12)
    return np.stack([6.0 - 6.0 * np.cos(angle), 6.0 * np.sin(angle)], axis=1)


def test_a_recording_can_be_shifted_onto_its_network(street: Path) -> None:
    far = recording([replace(WEST, x_m=1090.0)])
    scene, there = from_tracks(street, far, shift_m=(-1000.0, 0.0)), from_tracks(street, recording([WEST]))
    np.testing.assert_allclose(scene.recordings[0].box["x_m"], there.recordings[0].box["x_m"])
    assert scene.cases[0].start_m == pytest.approx(there.cases[0].start_m)


def test_persons_on_foot_are_no_cars(street: Path) -> None:
    walker = Driven("walker", 20.0, UPPER_Y_M, 1.2, size_m=(0.5, 0.5), vehicle_class="pedestrian")
    scene = from_tracks(street, recording([WEST, walker]))
    assert scene.vtypes == ("car", "pedestrian")
    assert [scene.recordings[0].vehicles[case.track] for case in scene.cases] == ["west"]
    with pytest.raises(InputError, match="the ego cannot take over vehicle walker, which is no car"):
        from_tracks(street, recording([WEST, walker]), "walker")


@pytest.mark.parametrize(
    ("route", "lane", "y_m"), [(("ab",), "ab_1", -4.8), (("ab", "bc"), "ab_1", -4.8), (("ab", "bd"), "ab_2", -1.6)]
)
def test_an_ego_on_edges_begins_on_a_lane_for_cars_that_leads_on(
    pavements: Path, route: tuple[str, ...], lane: str, y_m: float
) -> None:
    ego, far = EgoOnEdges(route, 12.0, 70.0, every_s=100.0), Driven("far", 100.0, -1.6, 1.0)
    (case,) = from_tracks(pavements, recording([far]), ego).cases
    assert case.lane == lane
    np.testing.assert_allclose(case.way.box["y_m"][:100], y_m)
    stands = Driven("stands", 12.0, y_m, 0.0)
    with pytest.raises(InputError, match="no room at its start"):
        from_tracks(pavements, recording([stands]), ego)


@pytest.mark.parametrize(
    ("vehicles", "ego", "message"),
    [
        (
            [replace(WEST, x_m=5000.0)],
            None,
            "street.net.xml does not belong to street.csv: .* give `shift_m`, or another network",
        ),
        ([WEST], "east", "no recorded vehicle is called 'east'; choose one of west"),
        ([WEST], 7, "ego must be names of recorded vehicles"),
        ([WEST], [], "ego names no vehicle"),
        ([replace(WEST, last_s=0.5)], None, "recording street of street.csv lasts 0.5 s; give one of at least 1 s"),
        ([replace(WEST, speed_mps=-0.1)], None, "the ego cannot take over vehicle west, which drives less than 10 m"),
        ([WEST], EgoOnEdges(("stem.0", "upper_in.0"), 5.0, 20.0), "no way for passenger cars leads from edge"),
        ([WEST], EgoOnEdges(("stem.0", "mid.0"), 5.0, 200.0), "must lie on its route"),
        ([replace(WEST, speed_mps=-0.1, x_m=65.0)], EgoOnEdges(("lower_in.0",), 40.0, 90.0), "no room at its start"),
    ],
)
def test_bad_input_is_one_clear_line(street: Path, vehicles: list[Driven], ego: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        from_tracks(street, recording(vehicles), ego)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"net": 5}, "net must be the file of a SUMO network, not 5"),
        ({"tracks": None}, "tracks must be a file of tracks, or Tracks, not None"),
        ({"reactive": "yes"}, "reactive must be True or False, not 'yes'"),
        ({"yields": ["west"]}, "yields must be a mapping"),
        *(
            ({"shift_m": shift_m}, "shift_m must be two numbers, added to x and y in m, not")
            for shift_m in (3, "a", (1, 2, 3), None, ("a", "b"), (0.0, float("nan")), (1.0, (2.0, 3.0)))
        ),
        ({"step_s": 0.0}, "step_s must lie in 0.01 to 1, not 0.0"),
        ({"step_s": 0.0333}, "step_s must be whole milliseconds"),
        ({"release_m": -1.0}, "release_m must lie in"),
        ({"drivers": 3}, "drivers must be the folder of a fit"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(street: Path, arguments: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"net": street, "tracks": recording([WEST]), **arguments}
    with pytest.raises(InputError, match=message):
        from_tracks(**given)


def test_files_and_names_that_do_not_exist_are_refused(street: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        from_tracks(tmp_path / "no.net.xml", recording([WEST]))
    with pytest.raises(InputError, match="no file"):
        from_tracks(street, tmp_path / "no.csv")
    with pytest.raises(InputError, match="yields names none of the recorded vehicles"):
        from_tracks(street, recording([WEST]), yields={"nobody": True})


@pytest.mark.parametrize(
    ("x_m", "last_s", "route"),
    [
        (6.0, 8.0, ("lower_in.0", "lower_out.0")),  # appears on the junction
        (30.0, 3.0, ("lower_in.0", "lower_out.0")),  # vanishes there
        (6.5, 1.0, ("lower_in.0", "lower_out.0")),  # is only seen there
    ],
)
def test_vehicles_seen_on_a_junction_have_the_edges_before_and_behind_it(
    street: Path, x_m: float, last_s: float, route: tuple[str, ...]
) -> None:
    mover = replace(WEST, x_m=x_m, last_s=last_s)
    (one,) = from_tracks(street, recording([mover, Driven("east", -90.0, UPPER_Y_M, 10.0)]), "east").recordings
    assert one.routes[one.vehicles.index("west")] == route
    assert one.keeps_route.all()


def test_a_file_of_tracks_is_read(street: Path, tmp_path: Path) -> None:
    """SUMO's floating-car data, whose positions are those of fronts."""
    steps = "".join(
        f'<timestep time="{step / 10:.1f}"><vehicle id="west" x="{87.5 - step}" y="{LOWER_Y_M}" angle="270" speed="10" '
        f'pos="{step}" lane="lower_in.0_0" type="car"/></timestep>'
        for step in range(151)
    )
    file = tmp_path / "fcd.xml"
    file.write_text(f"<fcd-export>{steps}</fcd-export>", encoding="utf-8")
    scene, known = from_tracks(street, file), from_tracks(street, recording([WEST]))
    assert scene.name == "fcd"
    np.testing.assert_allclose(scene.recordings[0].box["x_m"], known.recordings[0].box["x_m"])
    assert scene.cases[0].goal_m == pytest.approx(known.cases[0].goal_m)


def test_a_recording_is_not_described_as_a_sumo_configuration(street: Path) -> None:
    """Its policy, or its dataset, could not be read again."""
    scene = from_tracks(street, recording([WEST]))
    for describe in (lambda: described([scene]), lambda: env_spec(TaskSettings(scene))):
        with pytest.raises(InputError, match="scene street is a recording, which the files of policies and datasets"):
            describe()
