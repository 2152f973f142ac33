import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.study.scenes import given, trained, write_results
from tint_sumo.config import ALL_MIXES, Idm, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.methods.evaluation import TUNING_SET
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.report import write_report
from tint_sumo.study.results import Result, read_results

SOME_RESULTS = [
    trained("oracle", 1, {Conditions(Mix(0.4)): (8, 1, 1), Conditions(ALL_MIXES, 0.05, 0.7, 25): (3, 0, 2)}),
    trained("vae", 0, {Conditions(Mix(0.25)): (1, 0, 0)}, mix=Mix(0.25)),
    given("ttc", {Conditions(Mix(0.25)): (0, 0, 3), Conditions(ALL_MIXES, world="acc"): (1, 1, 1)}),
]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return write_results(SOME_RESULTS, tmp_path)


def test_files_give_back_the_results(study: Path) -> None:
    assert read_results(study) == SOME_RESULTS


def test_a_file_says_how_the_policy_fared_without_a_look_at_the_cases(study: Path) -> None:
    content = json.loads((study / RESULTS / "0.json").read_text())
    assert (content["method"], content["origin"], content["mix"], content["seed"]) == (
        "oracle",
        "trained",
        [0.1, 0.9],
        1,
    )
    first, second = content["tested"]
    assert (first["p_conservative"], first["position_noise_m"], first["tau_s"]) == (0.4, 0.0, Idm.tau_s)
    assert (first["success"], first["timeout"], first["collision"], first["percent"]) == (0.8, 0.1, 0.1, 100)
    assert (second["p_conservative"], second["position_noise_m"], second["tau_s"]) == ([0.1, 0.9], 0.05, 0.7)
    assert (second["success"], second["percent"]) == (0.6, 25)


def test_a_file_tells_the_headway_of_the_scene_where_none_was_given(tmp_path: Path) -> None:
    tested = {Conditions(Mix(0.4)): (8, 1, 1), Conditions(Mix(0.4), tau_s=1.0): (1, 0, 0)}
    result = replace(trained("oracle", 0, tested), scene_tau_s=1.5)
    file = write_results([result], tmp_path) / RESULTS / "0.json"
    assert [one["tau_s"] for one in json.loads(file.read_text())["tested"]] == [1.5, 1.0]
    assert Result.read(file) == result


def test_a_file_without_the_scene_s_headway_is_of_drivers_with_the_default_one(study: Path) -> None:
    file = study / RESULTS / "0.json"
    content = json.loads(file.read_text())
    del content["scene_tau_s"]
    file.write_text(json.dumps(content))
    assert read_results(study) == SOME_RESULTS


def test_a_policy_that_no_test_is_for_has_no_cases(tmp_path: Path) -> None:
    untested = trained("oracle", 0, {}, mix=Mix(0.25))
    results = [untested, *SOME_RESULTS]
    assert read_results(write_results(results, tmp_path)) == results


def test_results_of_a_sweep_are_no_study_s(tmp_path: Path) -> None:
    tuned = replace(SOME_RESULTS[0], case_set=TUNING_SET)
    write_results([tuned], tmp_path)
    assert Result.read(tmp_path / RESULTS / "0.json") == tuned
    with pytest.raises(InputError, match="is part of a sweep, whose cases no study reports"):
        read_results(tmp_path)


def test_a_result_that_names_no_set_of_cases_is_of_the_reported_ones(study: Path) -> None:
    file = study / RESULTS / "0.json"
    content = json.loads(file.read_text())
    assert content.pop("case_set") == 0
    file.write_text(json.dumps(content))
    assert read_results(study) == SOME_RESULTS


def test_no_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no results in .*; run the study first"):
        write_report(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "\0", '{"method": "ttc", "p_conservative": 0.4, "cases": []}'])
def test_files_that_are_no_results_are_named(study: Path, text: str) -> None:
    damage(study, text)


@pytest.mark.parametrize("entry", ["method", "origin", "mix", "seed", "tested"])
def test_results_with_a_part_missing_are_named(study: Path, entry: str) -> None:
    content = SOME_RESULTS[0].to_json()
    del content[entry]
    damage(study, json.dumps(content))


@pytest.mark.parametrize(
    "change",
    [
        {"cases": []},
        {"cases": [["flew", 1.0, None, None]]},
        {"cases": [["success", "soon", None, None]]},
        {"cases": [["success", 1.0, None, None, None]]},
        {"cases": [1]},
        {"cases": None},
        {"p_conservative": None},
        {"p_conservative": []},
        {"p_conservative": [0.1, 0.5, 0.9]},
        {"p_conservative": "many"},
        {"tau_s": None},
        {"percent": "all"},
    ],
)
def test_results_with_a_damaged_part_are_named(study: Path, change: dict[str, Any]) -> None:
    content = SOME_RESULTS[0].to_json()
    content["tested"][1] |= change
    damage(study, json.dumps(content))


def damage(study: Path, text: str) -> None:
    """Write ``text`` in place of a result, and see that the error is one line and that no report is made."""
    file = study / RESULTS / "1.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"1\.json is damaged.*") as refusal:
        write_report(study)
    assert "\n" not in str(refusal.value)
    assert sorted(path.name for path in study.iterdir()) == [RESULTS]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"result of a study: no file .*gone\.json"):
        Result.read(tmp_path / "gone.json")


def test_results_without_a_test_are_refused(tmp_path: Path) -> None:
    write_results([trained("oracle", 0, {})], tmp_path)
    with pytest.raises(InputError, match=r"no policy of .* was tested"):
        read_results(tmp_path)
