"""A small but real sweep, what it plans and refuses, and its table."""

import json
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import pandas as pd
import pytest
import yaml

from tint_sumo.cli import main
from tint_sumo.comparisons.sweep import Sweep, VariantJob, plan, read_varied, report_markdown, run_sweep
from tint_sumo.config import CONSERVATIVE, Mix, Population, PpoSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import silent
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.evaluation import TUNING_SET, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.scenes import find_scene
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.results import Measured, Result

COLUMNS = ["variant", "method", "seed", "p_conservative", "success", "timeout", "collision", "navigation_time_s"]
VARIANTS = ["learning_rate=0.001", "learning_rate=0.003"]
LONG = f"[{','.join(['1024'] * 8)}]"


@pytest.fixture(scope="module")
def sweep(brief: PpoSettings) -> Sweep:
    return Sweep(brief, {"learning_rate": [1e-3, 3e-3]}, p_conservative=Mix(0.4), episodes=3)


# A sweep


@pytest.fixture(scope="module")
def finished(sweep: Sweep, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sweep, made by a command."""
    folder = tmp_path_factory.mktemp("runs")
    values = {"set": "learning_rate=0.001,3e-3", "p_conservative": 0.4, "episodes": 3, "budget": asdict(sweep.settings)}
    (folder / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(values))))
    out = folder / "sweep"
    assert main(["policy", "sweep", "--config", str(folder / "config.yaml"), "--out", out.as_uri()]) == 0
    return out


@pytest.mark.slow
def test_a_sweep_leaves_a_table_and_the_policies_of_each_variant(sweep: Sweep, finished: Path) -> None:
    table = pd.read_csv(finished / "sweep.csv")
    assert list(table) == COLUMNS
    assert table[COLUMNS[:4]].to_numpy().tolist() == [[variant, "oracle", 0, 0.4] for variant in VARIANTS]
    assert table[["success", "timeout", "collision"]].sum(axis=1).tolist() == pytest.approx([1.0, 1.0])
    assert (finished / "sweep.md").read_text() == report_markdown(table, 3)
    for variant, settings in sweep.variants.items():
        card = json.loads((finished / variant / "policies" / "oracle-P0.4-seed0" / "policy.json").read_text())
        assert card["settings"]["learning_rate"] == settings.learning_rate


@pytest.mark.slow
def test_policies_are_tested_on_cases_that_are_reported_nowhere(finished: Path) -> None:
    policy = load_policy(finished / VARIANTS[0] / "policies" / "oracle-P0.4-seed0")
    expected = evaluate(
        policy.policy,
        lambda count: policy.make_venv(count, TaskSettings(policy.scene, p_conservative=0.4)),
        3,
        TUNING_SET,
    )
    result = Result.read(finished / VARIANTS[0] / "results" / "oracle-P0.4-seed0.json")
    assert (result.case_set, result.tested) == (TUNING_SET, (Measured(Conditions(Mix(0.4)), expected),))


@pytest.mark.slow
def test_the_same_command_does_nothing_again_and_prints_the_same_rows(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.parent != finished}
    config = finished.with_name("config.yaml")
    assert main(["policy", "sweep", "--config", str(config), "--out", str(finished), "--json"]) == 0
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.parent != finished} == made
    *lines, last = capsys.readouterr().out.splitlines()
    files = [str(finished / name) for name in ("sweep.csv", "sweep.md")]
    assert "\n".join(lines) == f"{(finished / 'sweep.md').read_text()}\n" + "\n".join(f"wrote {one}" for one in files)
    table = pd.read_csv(finished / "sweep.csv")
    rows = table.astype(object).where(table.notna(), None).to_dict("records")
    assert json.loads(last, parse_constant=pytest.fail) == {"results": rows, "files": files}


@pytest.mark.slow
def test_another_sweep_in_the_same_folder_is_refused(sweep: Sweep, finished: Path) -> None:
    with pytest.raises(InputError, match=r"already holds another run \(different: varied\)"):
        run_sweep(replace(sweep, varied={"n_epochs": [1]}), finished, progress=False)


# The plan


def test_a_job_works_in_any_folder_that_holds_its_inputs(brief: PpoSettings, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    sweep = Sweep(brief, {"n_epochs": [1]}, p_conservative=Mix(0.4), episodes=2)
    for job in plan(sweep, here):
        moved = replace(job, out=there)
        assert all((there / path).exists() for path in job.inputs)
        before = set(files_in(there))
        assert not moved.is_done()
        moved.run(silent)
        assert moved.is_done() and not job.is_done()
        written = set(files_in(there)) - before
        assert written and all(file.startswith(job.outputs) for file in written)
    assert not here.exists()


def files_in(folder: Path) -> list[str]:
    return [str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()]


def test_the_plan_is_every_method_and_seed_of_every_variant(brief: PpoSettings, tmp_path: Path) -> None:
    varied = {"n_epochs": [1, 2], "policy.head_sizes": [[8, 8], 4]}
    jobs = plan(Sweep(brief, varied, methods=("oracle", "ma"), seeds=(1, 0)), tmp_path)
    variants = [f"n_epochs={count},policy.head_sizes={sizes}" for count in (1, 2) for sizes in ("8x8", "4")]
    for kind in (TrainJob, EvaluateJob):
        found = [(job.variant, job.job.method, job.job.seed) for job in jobs if isinstance(job.job, kind)]
        assert sorted(found) == sorted(product(variants, ("oracle", "ma"), (0, 1)))
    settings = {job.variant: job.job.settings for job in jobs if isinstance(job.job, TrainJob)}
    assert settings["n_epochs=2,policy.head_sizes=8x8"] == replace(
        brief, n_epochs=2, policy=replace(brief.policy, head_sizes=(8, 8))
    )
    assert len({job.name for job in jobs}) == len(jobs)
    assert [job.job.seed for job in jobs] == sorted(job.job.seed for job in jobs)


def test_a_method_that_shares_a_training_brings_it_along(brief: PpoSettings, tmp_path: Path) -> None:
    jobs = plan(Sweep(brief, {"n_epochs": [1, 2]}, methods=("ma",)), tmp_path)
    assert [job.job.method for job in jobs if isinstance(job.job, EvaluateJob)] == ["ma", "ma"]
    seen: dict[str, VariantJob] = {}
    for job in jobs:
        assert all(seen[name].variant == job.variant for name in job.needs), "jobs of other variants"
        assert all(set(job.inputs) >= set(seen[name].outputs) for name in job.needs)
        seen[job.name] = job
    assert [job.job.method for job in jobs if not job.needs] == ["oracle", "oracle"]


def test_policies_are_tested_at_the_mixes_of_their_training(brief: PpoSettings) -> None:
    assert Sweep(brief, {"n_epochs": [1]}).tested == (0.25, 0.4, 0.6)
    assert Sweep(brief, {"n_epochs": [1]}, p_conservative=Mix(0.3, 0.6)).tested == (0.4, 0.6)


# Bad input


def test_words_say_values_as_files_do() -> None:
    assert read_varied(["learning_rate=1e-3,0.003", "policy.head_sizes=[64, 64],32"]) == {
        "learning_rate": [1e-3, 3e-3],
        "policy.head_sizes": [[64, 64], 32],
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("n_epochs", "'n_epochs' must be NAME=VALUE,VALUE"),
        ("n_epochs=2 n_epochs=3", "n_epochs is given twice"),
        ("n_epochs=2,,3", "'2,,3' must be values with commas between them"),
        ("n_epochs=[2", "must be values with commas"),
        ("n_epochs=", "n_epochs needs a value"),
        ("learnin_rate=1", "learnin_rate: there is no such setting; did you mean learning_rate?"),
        ("policy.hiden_size=1", "did you mean policy.hidden_size?"),
        ("policy=1", "policy: there is no such setting"),
        ("policy.attention=false", "compare with the method no_attention"),
        ("n_epochs=2.5", "n_epochs: must be a whole number from 1 to 1,000, not 2.5"),
        ("policy.hidden_size=big", "policy.hidden_size: must be a whole number from 1 to 2,048, not 'big'"),
        ("n_epochs=0", "n_epochs: must lie in 1 to 1,000, not 0"),
        ("n_envs=2,4 n_minibatches=1,4", "n_minibatches must be at most n_envs (2)"),
        ("learning_rate=0.001,1e-3", "learning_rate must have each value once, not 0.001, 0.001"),
        (f"policy.head_sizes=[{','.join(['1'] * 9)}]", "policy.head_sizes: must have 0 to 8 values, not 9"),
        (f"policy.head_sizes={LONG} policy.joint_sizes={LONG} policy.score_sizes={LONG}", "more than 150; vary fewer"),
        ("n_epochs=2 --methods ttc", "is a hand-written rule"),
        ("n_epochs=2 --methods oracle oracle", "methods must be one or more, each of them once"),
        ("n_epochs=2 --methods vae ma --scene on_ramp", "vae, ma: the shipped trait models know the scene"),
        ("n_epochs=2 --scene all", "unknown scene 'all'"),
        ("n_epochs=2 --seeds", "seeds must be one or more"),
        ("n_epochs=2 --seeds 1001", "seeds must lie in 0 to 1,000, not 1001"),
        ("n_epochs=2 --episodes 0", "episodes must lie in 1"),
        ("n_epochs=2 --p-conservative 0.7 0.9", "must include one of 0.25, 0.4, 0.6, where policies are tested"),
        ("", "a sweep needs a setting to vary"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    assert main(["policy", "sweep", "--out", str(out), "--set", *words.split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert not out.exists()


def test_scenes_with_other_drivers_than_two_profiles_are_refused(brief: PpoSettings) -> None:
    scene = replace(find_scene("on_ramp"), name="own", population=Population((CONSERVATIVE,)))
    with pytest.raises(InputError, match="a sweep needs exactly two kinds of drivers, and scene own has 1"):
        Sweep(brief, {"n_epochs": [1]}, scene=scene)


# The table


def test_the_best_line_of_the_table_comes_first() -> None:
    shares = {
        ("n_epochs=2", "oracle"): {0.25: (0.8, 0.9), 0.4: (1.0, 1.0)},  # sd of 80 and 90: sqrt(2 * 5^2) = 7.07
        ("n_epochs=4", "oracle"): {0.25: (0.9, 0.9), 0.4: (1.0, 1.0)},
        ("n_epochs=4", "ma"): {0.25: (0.0, 0.5), 0.4: (0.75, 0.75)},
    }
    table = pd.DataFrame(
        [
            {"variant": variant, "method": method, "seed": seed, "p_conservative": p, "success": share}
            for (variant, method), found in shares.items()
            for p, of_seeds in found.items()
            for seed, share in enumerate(of_seeds)
        ]
    )
    heading, _, *lines, _, note = report_markdown(table, 20).splitlines()
    assert heading == "## Success by settings of PPO"
    assert lines == [
        "| settings   | method | P 0.25      | P 0.4       | mean |",
        "| ---------- | ------ | ----------- | ----------- | ---- |",
        "| n_epochs=4 | oracle | 90.0 ± 0.0  | 100.0 ± 0.0 | 95.0 |",
        "| n_epochs=2 | oracle | 85.0 ± 7.1  | 100.0 ± 0.0 | 92.5 |",
        "| n_epochs=4 | ma     | 25.0 ± 35.4 | 75.0 ± 0.0  | 50.0 |",
    ]
    assert note.startswith("Success in percent of 20 cases")
    nearly = report_markdown(table.assign(success=0.9999), 20)
    assert "| >99.9 ± 0.0 | >99.9 ± 0.0 | >99.9 |" in nearly
    one_seed = report_markdown(table[table["seed"] == 1], 20)
    assert "| n_epochs=4 | ma     | 50.0   | 75.0  | 62.5 |" in one_seed
