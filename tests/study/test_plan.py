"""The study's plan, and a small but real study: recording, trainings and tests in worker processes, tables."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tint_sumo.comparisons.sweep import Sweep
from tint_sumo.comparisons.traits import TraitStudy
from tint_sumo.config import ALL_MIXES, Idm, Mix, PolicySettings, PpoSettings, TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.registry import Learned, find_method
from tint_sumo.scenes import find_scene
from tint_sumo.study.budgets import BUDGETS, Budget, Conditions, Trials
from tint_sumo.study.ceiling_job import CeilingJob
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.plan import plan, run_study
from tint_sumo.study.results import read_results
from tint_sumo.study.trait_job import TraitJob

POLICIES = ("oracle-P0.4-seed0", "ma-P0.4-seed0")
AT_MIX, HALF, ELSEWHERE = Conditions(Mix(0.4)), Conditions(Mix(0.4), percent=50), Conditions(Mix(0.9))


@pytest.fixture(scope="module")
def budget(brief: PpoSettings) -> Budget:
    """A rule, a policy trained at one mix, and one that shares its training and learns its own traits."""
    traits = TraitSettings(
        embedding_sizes=(), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=64, epochs=1
    )
    return Budget(
        windows=100,
        traits=traits,
        ppo=brief,
        methods=("always_go", "ma", "oracle"),
        mixes=(Mix(0.4),),
        seeds=(0,),
        trials=(Trials((AT_MIX, HALF), 3), Trials((ELSEWHERE,), 2)),
    )


@pytest.fixture(scope="module")
def finished(budget: Budget, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "study"
    run_study(budget, out, workers=2, progress=False)
    return out


def times(out: Path) -> dict[str, int]:
    return {str(path.relative_to(out)): path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def test_a_headway_that_is_the_scene_s_is_planned_like_one_that_is_not_given(tmp_path: Path) -> None:
    given = tuple(Trials((Conditions(Mix(0.4), tau_s=tau_s),), 1) for tau_s in (1.0, 1.5))
    scene = find_scene("four_way")
    slow = replace(scene, name="slow", population=replace(scene.population, idm=Idm(tau_s=1.5)))
    jobs = plan(replace(BUDGETS["quick"], trials=given), tmp_path, slow)
    planned = tuple(Trials((one,), 1) for one in (Conditions(Mix(0.4), tau_s=1.0), Conditions(Mix(0.4))))
    tests = [job for job in jobs if isinstance(job, EvaluateJob | CeilingJob)]
    assert tests and all(job.trials == planned for job in tests)


@pytest.mark.parametrize(
    "trials",
    [
        (Trials((AT_MIX, Conditions(Mix(0.4), tau_s=Idm.tau_s)), 3),),  # the headway is the scene's
        (Trials((AT_MIX,), 3), Trials((AT_MIX,), 5)),
    ],
)
def test_the_same_conditions_twice_are_refused(trials: tuple[Trials, ...], budget: Budget, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"each conditions once, not P\(conservative\) 0\.4 as trained 2 times"):
        plan(replace(budget, trials=trials), tmp_path)


def test_a_mix_in_training_that_no_test_meets_is_refused(budget: Budget, tmp_path: Path) -> None:
    untested = replace(budget, mixes=(Mix(0.4), Mix(0.5)))
    with pytest.raises(InputError, match=r"policies trained at 0\.5 are tested nowhere"):
        plan(untested, tmp_path)
    assert plan(replace(untested, methods=("always_go",)), tmp_path), "rules are trained at no mix"


def test_methods_without_a_trait_model_are_studied_in_any_scene(budget: Budget, tmp_path: Path) -> None:
    shipped = replace(budget, traits=None, windows=0, methods=("ttc", "no_labels", "oracle"))
    assert plan(shipped, tmp_path, find_scene("roundabout"))
    with pytest.raises(InputError, match=r"^ma: the shipped trait models know .*, not roundabout; give the"):
        plan(replace(shipped, methods=("ma", "oracle")), tmp_path, find_scene("roundabout"))


@pytest.mark.slow
def test_a_study_leaves_everything_it_made(finished: Path) -> None:
    made = {str(path.relative_to(finished)) for path in finished.rglob("*")}
    assert made >= {
        "dataset/manifest.json",
        "traits/classifier/model.safetensors",
        "traits/classifier/evaluation.json",
        "traits/classifier/latent.png",
        *(f"policies/{policy}/{part}.safetensors" for policy in POLICIES for part in ("policy", "policy-50")),
        "policies/oracle-P0.4-seed0/curve.csv",
        "results/always_go.json",
        *(f"results/{policy}.json" for policy in POLICIES),
        "ceilings.json",
        "results.csv",
        "results.md",
        "results.png",
        "conditions.png",
        "curves.png",
    }
    assert not [path for path in made if path.endswith((".partial", ".zip", ".pt", ".pkl"))]
    accuracy = json.loads((finished / "traits/classifier/evaluation.json").read_text())["accuracy"]
    assert json.loads((finished / "traits/classifier/model.json").read_text())["accuracy"] == accuracy


@pytest.mark.slow
def test_policies_are_tested_at_their_mix_alone_and_rules_everywhere(finished: Path) -> None:
    tested = {one.method: [fared.conditions for fared in one.tested] for one in read_results(finished)}
    assert tested == {"oracle": [AT_MIX, HALF], "ma": [AT_MIX, HALF], "always_go": [AT_MIX, ELSEWHERE]}
    table = (finished / "results.md").read_text()
    assert "| P 0.4" in table and "| ceiling" in table


@pytest.mark.slow
def test_policies_take_the_study_s_traits_and_the_training_they_share(finished: Path) -> None:
    model = (finished / "traits" / "classifier" / "model.safetensors").read_bytes()
    oracle, ma = (finished / "policies" / policy for policy in POLICIES)
    assert (ma / "traits.safetensors").read_bytes() == model
    assert (ma / "policy.safetensors").read_bytes() == (oracle / "policy.safetensors").read_bytes()
    assert load_policy(ma).action_repeat == load_policy(oracle).action_repeat == 1


@pytest.mark.slow
def test_only_what_is_missing_is_made_again(budget: Budget, finished: Path) -> None:
    before = times(finished)
    lost = finished / "results" / "always_go.json"
    content = lost.read_text()
    lost.unlink()
    report = run_study(budget, finished, workers=1, progress=False)
    assert lost.read_text() == content
    assert {row.method for row in report.rows} == {"always_go", "ma", "oracle"}
    changed = {path for path, time in times(finished).items() if before.get(path) != time}
    written = {"results.csv", "results.md", "results.png", "conditions.png", "curves.png", "report.html"}
    assert changed == {"results/always_go.json", *written}


@pytest.mark.slow
def test_another_budget_in_the_same_folder_is_refused(budget: Budget, finished: Path) -> None:
    before = times(finished)
    for other in (BUDGETS["quick"], replace(budget, seeds=(1,))):
        with pytest.raises(InputError, match="already holds another run"):
            run_study(other, finished, progress=False)
    assert times(finished) == before


# The plan


@pytest.mark.parametrize("name", BUDGETS)
def test_the_plan_is_the_whole_grid(tmp_path: Path, name: str) -> None:
    budget = replace(BUDGETS[name], with_shipped=False)
    jobs = plan(budget, tmp_path)
    learned = {method for method in budget.methods if isinstance(find_method(method), Learned)}
    grid_of_policies = {(method, mix, seed) for method in learned for mix in budget.mixes for seed in budget.seeds}
    trained = [(job.method, job.mix, job.seed) for job in jobs if isinstance(job, TrainJob)]
    tested = [(job.method, job.mix, job.seed) for job in jobs if isinstance(job, EvaluateJob)]
    assert len(trained) == len(grid_of_policies) and set(trained) == grid_of_policies
    assert set(tested) == grid_of_policies | {(method, None, 0) for method in budget.methods if method not in learned}
    assert sum(isinstance(job, CeilingJob) for job in jobs) == 1
    assert len({job.name for job in jobs}) == len(jobs)


@pytest.mark.parametrize("name", BUDGETS)
def test_what_a_job_needs_comes_before_it(tmp_path: Path, name: str) -> None:
    seen: set[str] = set()
    for job in plan(BUDGETS[name], tmp_path):
        assert set(job.needs) <= seen, f"{job.name} would wait for what comes later"
        seen.add(job.name)


def test_one_seed_is_finished_before_the_next_is_begun(tmp_path: Path) -> None:
    jobs = plan(BUDGETS["full"], tmp_path)
    seeds = [job.seed for job in jobs if isinstance(job, TrainJob | EvaluateJob) and job.mix is not None]
    assert seeds == sorted(seeds)


def test_traits_are_learnt_first_where_the_budget_learns_them_and_nowhere_else(tmp_path: Path, budget: Budget) -> None:
    jobs = plan(budget, tmp_path)
    assert [job.name for job in jobs if isinstance(job, TraitJob)] == ["traits classifier"] == [jobs[0].name]
    every = plan(replace(budget, methods=("vae", "no_attention", "streaming", "oracle", "ma")), tmp_path)
    assert [job.method for job in every if isinstance(job, TraitJob)] == ["vae", "cross_window", "classifier"]
    given = plan(replace(budget, traits=None, windows=0), tmp_path)
    assert not [job for job in given if isinstance(job, TraitJob)]
    assert not [need for job in given for need in job.needs if need.startswith("traits")]


def test_a_study_refuses_settings_that_none_of_its_stages_uses(tmp_path: Path) -> None:
    no_attention = replace(BUDGETS["quick"].ppo, policy=PolicySettings(attention=False))
    with pytest.raises(InputError, match=r"attention is part of the method, and no_labels has it"):
        plan(replace(BUDGETS["quick"], ppo=no_attention), tmp_path)
    for unused in ({"windows": 100}, {"record_p_conservative": 0.4}):
        with pytest.raises(InputError, match="windows are recorded to learn traits from"):
            replace(BUDGETS["full"], **unused)
    with pytest.raises(InputError, match=r"settings\.noise_m has no use"):
        TraitStudy(settings=replace(TraitSettings(), noise_m=0.1))
    with pytest.raises(InputError, match="oracle has it"):
        Sweep(no_attention, {"n_epochs": [1, 2]})


def test_ma_needs_the_oracle_s_training_with_the_same_seed_and_mix(tmp_path: Path, budget: Budget) -> None:
    jobs = plan(replace(budget, mixes=(Mix(0.4), ALL_MIXES), seeds=(0, 1)), tmp_path)
    needs = {job.name: job.needs for job in jobs if isinstance(job, TrainJob) and job.method == "ma"}
    assert needs == {
        f"train ma-{which}": ("traits classifier", f"train oracle-{which}")
        for which in ("P0.4-seed0", "P0.1to0.9-seed0", "P0.4-seed1", "P0.1to0.9-seed1")
    }


def test_a_training_that_is_shared_is_done_without_its_method_being_asked_for(tmp_path: Path, budget: Budget) -> None:
    jobs = plan(replace(budget, methods=("ma",)), tmp_path)
    assert [job.name for job in jobs if isinstance(job, TrainJob | EvaluateJob)] == [
        "train oracle-P0.4-seed0",
        "train ma-P0.4-seed0",
        "evaluate ma-P0.4-seed0",
    ]


def test_shipped_policies_are_tested_where_the_budget_says_so(
    tmp_path: Path, budget: Budget, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tint_sumo.study.plan.shipped_policies", lambda: ["vae", "oracle"])

    def given(with_shipped: bool) -> list[str]:
        jobs = plan(replace(budget, with_shipped=with_shipped), tmp_path)
        return [job.name for job in jobs if isinstance(job, EvaluateJob) and job.mix is None]

    assert given(False) == ["evaluate always_go"]
    assert given(True) == ["evaluate always_go", "evaluate vae-shipped", "evaluate oracle-shipped"]


def test_unknown_methods_and_too_few_workers_leave_no_folder(budget: Budget, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="workers must lie in 1 to 1,024"):
        run_study(budget, tmp_path / "study", workers=0)
    for name in ("magic", "ours"):
        with pytest.raises(InputError, match=f"{name}"):
            run_study(replace(budget, methods=(name,)), tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_a_study_is_in_the_steps_in_which_traits_are_inferred(budget: Budget, tmp_path: Path) -> None:
    slow = replace(find_scene("t_intersection"), name="slow", base="t_intersection", step_s=0.2)
    with pytest.raises(InputError, match=r"scene slow has steps of 0\.2 s, and traits are inferred in steps of 0\.1 s"):
        run_study(budget, tmp_path / "study", scene=slow)
    assert not (tmp_path / "study").exists()
