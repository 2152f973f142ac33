import json
from pathlib import Path

import pytest

from tint_sumo.config import PpoSettings, TraitSettings
from tint_sumo.errors import InputError
from tint_sumo.study.budgets import BUDGETS, Budget, find_budget
from tint_sumo.study.grid import plan, run_study
from tint_sumo.study.methods import METHODS, Learned, find_method
from tint_sumo.study.policy_job import PolicyJob
from tint_sumo.study.trait_job import TraitJob


@pytest.fixture(scope="module")
def budget() -> Budget:
    network = TraitSettings(
        embedding_sizes=(8, 8), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=64, epochs=1
    )
    return Budget(
        windows=100,
        traits=network,
        ppo=PpoSettings(n_envs=4, n_steps=16, n_epochs=1, n_minibatches=1, total_steps=64),
        methods=("always_go", "vae"),
        p_conservative=(0.4,),
        seeds=(0,),
        episodes=4,
    )


@pytest.fixture(scope="module")
def finished(budget: Budget, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "study"
    run_study(budget, out, workers=2, progress=False)
    return out


def times(out: Path) -> dict[str, int]:
    return {str(path.relative_to(out)): path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def test_a_study_leaves_everything_it_made(finished: Path) -> None:
    made = {str(path.relative_to(finished)) for path in finished.rglob("*")}
    assert made >= {
        "dataset/manifest.json",
        "traits/vae/model.safetensors",
        "traits/vae/evaluation.json",
        "traits/vae/latent.png",
        "policies/vae-P0.4-seed0/policy.zip",
        "results/always_go-P0.4-seed0.json",
        "results/vae-P0.4-seed0.json",
        "results.csv",
        "results.md",
        "results.png",
    }
    assert not [path for path in made if path.endswith(".partial")]
    accuracy = json.loads((finished / "traits/vae/evaluation.json").read_text())["accuracy"]
    assert json.loads((finished / "traits/vae/model.json").read_text())["accuracy"] == accuracy


def test_only_what_is_missing_is_made_again(budget: Budget, finished: Path) -> None:
    before = times(finished)
    lost = finished / "results" / "always_go-P0.4-seed0.json"
    content = lost.read_text()
    lost.unlink()
    report = run_study(budget, finished, workers=1, progress=False)
    assert lost.read_text() == content
    assert [row.method for row in report.rows] == ["always_go", "vae"]
    changed = {path for path, time in times(finished).items() if before.get(path) != time}
    assert changed == {"results/always_go-P0.4-seed0.json", "results.csv", "results.md", "results.png"}


def test_another_budget_in_the_same_folder_is_refused(finished: Path) -> None:
    before = times(finished)
    with pytest.raises(InputError, match="already holds another run"):
        run_study(BUDGETS["quick"], finished, progress=False)
    assert times(finished) == before


def test_the_plan_is_the_whole_grid(tmp_path: Path) -> None:
    budget = BUDGETS["paper"]
    jobs = plan(budget, tmp_path)
    grid = {(job.method, job.p_conservative, job.seed) for job in jobs if isinstance(job, PolicyJob)}
    assert len(grid) == len(budget.methods) * 3 * 3
    assert [job.name for job in jobs if isinstance(job, TraitJob)] == ["traits vae"]
    assert len({job.name for job in jobs}) == len(jobs)
    names = {job.name for job in jobs}
    assert all(set(job.needs) <= names for job in jobs)
    encoders = {job.method for job in jobs if isinstance(job, PolicyJob) and job.needs}
    assert encoders == {"vae"}


@pytest.mark.parametrize("name", BUDGETS)
def test_budgets(name: str) -> None:
    budget = find_budget(name)
    assert budget.methods == tuple(METHODS)
    assert all(find_method(method) for method in budget.methods)
    assert any(isinstance(find_method(method), Learned) for method in budget.methods)
    assert budget.ppo.n_minibatches <= budget.ppo.n_envs


def test_the_paper_s_budget() -> None:
    paper = BUDGETS["paper"]
    assert paper.ppo == PpoSettings()
    assert paper.traits == TraitSettings()
    assert (paper.p_conservative, len(paper.seeds), paper.episodes) == ((0.25, 0.4, 0.6), 3, 500)


def test_unknown_budget() -> None:
    with pytest.raises(InputError, match="unknown budget 'huge'; choose one of: quick, paper"):
        find_budget("huge")


def test_at_least_one_worker(budget: Budget, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="workers"):
        run_study(budget, tmp_path / "study", workers=0)
    assert not (tmp_path / "study").exists()
