import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tint_sumo.config import ALL_MIXES, Idm, Mix, PpoSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.core.progress import Progress, silent
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.evaluation import REPORTED_SET, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.registry import METHODS
from tint_sumo.methods.training import CURVE_FILE
from tint_sumo.scenes import find_scene
from tint_sumo.study import budgets, jobs
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.jobs import TrainJob, label, read_curves
from tint_sumo.study.results import GIVEN, TRAINED, Result

HEADER = "decisions,success,timeout,collision\n"


def make_job(method: str, mix: Mix | None, out: Path, *tests: tuple[tuple[Conditions, ...], int]) -> jobs.EvaluateJob:
    return jobs.EvaluateJob(method, mix, 0, tuple(budgets.Trials(*test) for test in tests), out)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, brief: PpoSettings) -> Path:
    """A study's folder with one training finished."""
    out = tmp_path_factory.mktemp("study")
    TrainJob("oracle", Mix(0.4), 0, brief, True, out).run(silent)
    return out


@pytest.mark.parametrize(
    ("method", "mix", "name"),
    [
        ("vae", Mix(0.4), "vae-P0.4-seed3"),
        ("vae", ALL_MIXES, "vae-P0.1to0.9-seed3"),
        ("vae", Mix(0.4, 0.4), "vae-P0.4-seed3"),
        ("vae", None, "vae-shipped"),
        ("ttc", None, "ttc"),
    ],
)
def test_files_are_named_after_method_mix_and_seed(method: str, mix: Mix | None, name: str) -> None:
    assert label(method, mix, 3) == name


def test_trainings_need_the_study_s_traits_and_the_training_they_share(tiny: PpoSettings, tmp_path: Path) -> None:
    def needs(method: str, shipped_traits: bool) -> tuple[str, ...]:
        return TrainJob(method, Mix(0.4), 2, tiny, shipped_traits, tmp_path).needs

    assert needs("oracle", False) == needs("no_labels", False) == needs("vae", True) == ()
    assert needs("streaming", False) == ("traits cross_window",)
    assert needs("ma", True) == ("train oracle-P0.4-seed2",)
    assert needs("ma", False) == ("traits classifier", "train oracle-P0.4-seed2")


def test_tests_need_their_policy_s_training(tmp_path: Path) -> None:
    assert make_job("vae", ALL_MIXES, tmp_path).needs == ("train vae-P0.1to0.9-seed0",)
    assert make_job("vae", None, tmp_path).needs == make_job("ttc", None, tmp_path).needs == ()


def test_jobs_of_a_study_have_names_of_their_own(tiny: PpoSettings, tmp_path: Path) -> None:
    jobs = [
        job
        for method in ("vae", "oracle")
        for mix in (Mix(0.4), ALL_MIXES)
        for job in (TrainJob(method, mix, 0, tiny, True, tmp_path), make_job(method, mix, tmp_path))
    ]
    assert len({job.name for job in jobs}) == len(jobs)


def test_a_training_leaves_its_policy_in_the_study_s_folder(study: Path, brief: PpoSettings) -> None:
    job = TrainJob("oracle", Mix(0.4), 0, brief, True, study)
    assert job.folder == study / "policies" / "oracle-P0.4-seed0"
    assert job.is_done()
    assert load_policy(job.folder).p_conservative == Mix(0.4)
    assert not replace(job, seed=1).is_done()


def test_a_training_takes_the_study_s_trait_model(tmp_path: Path, brief: PpoSettings, encoders: Path) -> None:
    (tmp_path / "traits" / "vae").mkdir(parents=True)
    for suffix in (".json", ".safetensors"):
        content = (encoders / f"vae{suffix}").read_bytes()
        (tmp_path / "traits" / "vae" / f"model{suffix}").write_bytes(content)
    reports: list[Progress] = []
    job = TrainJob("vae", Mix(0.4), 0, brief, False, tmp_path)
    assert job.run(reports.append) == "", "the last report says what came out"
    assert [(one.done, one.total) for one in reports] == [(0, 128), (64, 128), (128, 128)]
    assert (job.folder / "traits.safetensors").read_bytes() == (encoders / "vae.safetensors").read_bytes()


def test_a_shared_training_takes_no_training(study: Path, brief: PpoSettings) -> None:
    job = TrainJob("ma", Mix(0.4), 0, brief, True, study)
    assert job.run(silent) == "shares the training of oracle"
    assert job.is_done()
    job = make_job("ma", Mix(0.4), study, ((Conditions(Mix(0.4), percent=50),), 2))
    job.run(silent)
    assert Result.read(job.result_file).method == "ma"


def test_a_rule_is_tested_on_the_same_cases_as_everyone_but_not_after_parts_of_a_training(tmp_path: Path) -> None:
    other, part = Conditions(ALL_MIXES, tau_s=1.5), Conditions(Mix(0.4), percent=25)
    job = make_job("always_go", None, tmp_path, ((Conditions(Mix(0.4)), part), 4), ((other,), 3))
    assert not job.is_done()
    reports: list[Progress] = []
    assert job.run(reports.append).startswith("success ")
    assert job.is_done()
    assert [(one.done, one.total) for one in reports] == [(done, 7) for done in range(1, 8)]
    result = Result.read(job.result_file)
    assert (result.method, result.origin, result.mix) == ("always_go", GIVEN, None)
    assert [(one.conditions, len(one.evaluation.cases)) for one in result.tested] == [
        (Conditions(Mix(0.4)), 4),
        (other, 3),
    ]
    rule = load_policy("always_go")
    found = evaluate(
        rule.policy,
        lambda num_envs: rule.make_venv(num_envs, TaskSettings(rule.scene, p_conservative=0.4)),
        4,
        REPORTED_SET,
    )
    assert result.tested[0].evaluation == found


def test_a_result_knows_the_headway_of_its_scene(tmp_path: Path) -> None:
    scene = find_scene("t_intersection")
    slow = replace(scene, name="slow", population=replace(scene.population, idm=Idm(tau_s=1.5)))
    closer = Conditions(Mix(0.4), tau_s=Idm.tau_s)
    job = replace(make_job("always_go", None, tmp_path, ((Conditions(Mix(0.4)), closer), 6)), scene=slow)
    job.run(silent)
    result = Result.read(job.result_file)
    assert result.scene_tau_s == 1.5
    assert [one.conditions for one in result.tested] == [Conditions(Mix(0.4)), closer]
    ends = [[case.time_s for case in one.evaluation.cases] for one in result.tested]
    assert ends[0] != ends[1]


def test_a_policy_is_tested_among_the_drivers_of_its_training_and_after_parts_of_it(study: Path) -> None:
    conditions = (Conditions(Mix(0.4)), Conditions(Mix(0.4), percent=25), Conditions(Mix(0.9)), Conditions(ALL_MIXES))
    job = make_job("oracle", Mix(0.4), study, (conditions, 2))
    job.run(silent)
    result = Result.read(job.result_file)
    assert (result.origin, result.mix, result.seed) == (TRAINED, Mix(0.4), 0)
    assert [one.conditions for one in result.tested] == [Conditions(Mix(0.4)), Conditions(Mix(0.4), percent=25)]


@pytest.mark.parametrize(
    ("mix", "met"),
    [
        (ALL_MIXES, {Mix(0.1), Mix(0.4), Mix(0.9), Mix(0.2, 0.5), ALL_MIXES}),
        (Mix(0.4), {Mix(0.4)}),
        (None, {Mix(0.05), Mix(0.1), Mix(0.4), Mix(0.9), Mix(0.2, 0.5), Mix(0.0, 1.0), ALL_MIXES}),
    ],
)
def test_mixes_that_a_policy_is_tested_at_lie_within_those_of_its_training(
    tmp_path: Path, mix: Mix | None, met: set[Mix]
) -> None:
    job = make_job("oracle", mix, tmp_path)
    asked = [*map(Mix, (0.05, 0.1, 0.4, 0.9)), Mix(0.2, 0.5), Mix(0.0, 1.0), ALL_MIXES]
    assert {p for p in asked if job._meets(Conditions(p))} == met


def test_parts_of_a_training_are_other_policies(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[Path] = []

    def load(file: Path, **scene: Any) -> object:
        loaded.append(file)
        return load_policy(file, **scene)

    monkeypatch.setattr(jobs, "load_policy", load)
    parts = tuple(Conditions(Mix(0.4), percent=percent) for percent in (100, 25, 50))
    make_job("oracle", Mix(0.4), study, (parts, 1)).run(silent)
    assert [file.name for file in loaded] == [f"policy{part}.safetensors" for part in ("", "-25", "-50")]


def test_a_result_is_a_file_that_says_what_was_tested(study: Path) -> None:
    job = make_job("oracle", Mix(0.4), study, ((Conditions(Mix(0.4)),), 2))
    job.run(silent)
    content = json.loads(job.result_file.read_text())
    assert job.result_file == study / "results" / "oracle-P0.4-seed0.json"
    assert len(content["tested"][0]["cases"]) == 2


def test_curves_are_found_by_method_and_mix(tmp_path: Path) -> None:
    for name, success in (
        ("streaming-P0.1to0.9-seed0", 0.5),
        ("streaming-P0.1to0.9-seed1", 0.6),
        ("streaming-P0.4-seed0", 0.8),
        ("streaming_critic-P0.1to0.9-seed0", 0.7),
        ("no_labels-P0.1to0.9-seed0", 0.4),
    ):
        write_text(tmp_path / "policies" / name / CURVE_FILE, f"{HEADER}64,{success},0.1,0.1\n")
    write_text(tmp_path / "policies" / "oracle-P0.1to0.9-seed0" / CURVE_FILE, HEADER)  # no episode has ended yet
    (tmp_path / "policies" / "ma-P0.1to0.9-seed0").mkdir()  # it shares another one's training
    write_text(tmp_path / "policies" / "oracle-P0.4-seed0-old" / CURVE_FILE, "a copy by hand")
    curves = read_curves(tmp_path)
    assert {training: [curve["success"].tolist() for curve in seeds] for training, seeds in curves.items()} == {
        ("no_labels", ALL_MIXES): [[0.4]],
        ("streaming", ALL_MIXES): [[0.5], [0.6]],
        ("streaming", Mix(0.4)): [[0.8]],
        ("streaming_critic", ALL_MIXES): [[0.7]],
    }
    names = list(dict.fromkeys(name for name, _ in curves))
    assert names == [name for name in METHODS if name in names]


def test_a_study_without_trainings_has_no_curves(tmp_path: Path) -> None:
    assert read_curves(tmp_path) == {}


def test_the_curve_of_a_training_is_one_of_the_study(study: Path) -> None:
    (curve,) = read_curves(study)["oracle", Mix(0.4)]
    pd.testing.assert_frame_equal(
        curve, pd.DataFrame({"decisions": [64.0, 128.0], "success": 0.0, "timeout": 1.0, "collision": 0.0})
    )


@pytest.mark.parametrize(
    "text",
    ["", "decisions,success\n64,1\n", f"{HEADER}64,often,0,0\n", f"{HEADER}64,1,0,0\n1,2,3,4,5\n"]
    + [f"{HEADER}{line}\n" for line in ("64,2,0,0", "64,nan,0,0", "1e300,1,0,0", "-1,1,0,0", "64,1,0,0\n64,1,0,0")],
)
def test_damaged_curves_are_named(tmp_path: Path, text: str) -> None:
    write_text(tmp_path / "policies" / "oracle-P0.4-seed0" / CURVE_FILE, text)
    with pytest.raises(InputError, match=r"curve\.csv is damaged .*; restore it, or remove it") as refusal:
        read_curves(tmp_path)
    assert "\n" not in str(refusal.value)
