"""The whole study: record, learn traits, train and test every policy, report."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tint_sumo.config import Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder
from tint_sumo.core.structures import plain
from tint_sumo.dataset.recorder import record
from tint_sumo.jobs import Job, Workers, executor_of
from tint_sumo.methods.loading import shipped_policies
from tint_sumo.methods.registry import Learned, Rule, find_learned, find_method, with_shared_trainings
from tint_sumo.scenes import (
    T_INTERSECTION,
    AnyScene,
    Scene,
    described,
    find_scene,
    paper_scene,
    require_built_in,
    require_trait_steps,
)
from tint_sumo.scenes.drivers import require_two_kinds
from tint_sumo.study.budgets import Budget, Trials
from tint_sumo.study.ceiling_job import CeilingJob
from tint_sumo.study.folders import DATASET
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.page import write_page
from tint_sumo.study.report import StudyReport, write_report
from tint_sumo.study.trait_job import SEED, TraitJob


def plan(budget: Budget, out: Path, scene: Scene | None = None) -> list[Job]:
    """Return all jobs after the recording, seed by seed, those first that others wait for or that take longest."""
    base = scene or paper_scene()
    scene = budget.trained_in(base)
    learned = [name for name in budget.methods if isinstance(find_method(name), Learned)]
    rules = [name for name in budget.methods if name not in learned]
    for method in map(find_method, rules):
        if isinstance(method, Rule):
            method.scene_for(scene)  # refuses SUMO's driver
    trained = with_shared_trainings(learned)
    for name in trained:
        find_learned(name).settings_of(budget.ppo)  # refuses what does not fit before hours of work
    encoders = dict.fromkeys(filter(None, (find_learned(name).encoder for name in trained)))
    traits = [] if budget.traits is None else [TraitJob(name, budget.traits, out) for name in encoders]
    given = rules + (shipped_policies() if budget.with_shipped and base == paper_scene() else [])
    if any(find_learned(name).infers_traits for name in learned):
        require_trait_steps(scene)
    if budget.traits is None:
        remedy = "give the budget traits, and windows to learn them from, as the budget quick has"
        require_traits(learned, scene, remedy)
    trials = _trials_in(scene, budget)
    _require_tests(budget.mixes if learned else (), trials)
    jobs: list[Job] = [*traits]
    for seed in budget.seeds:
        trainings = [
            TrainJob(name, mix, seed, budget.ppo, budget.traits is None, out, scene, budget.sensors)
            for mix in budget.mixes
            for name in trained
        ]
        jobs += sorted(trainings, key=lambda job: len(job.needs))
        jobs += [EvaluateJob(name, mix, seed, trials, out, scene) for mix in budget.mixes for name in learned]
    tests = [EvaluateJob(name, None, 0, trials, out, scene) for name in given]
    return [*jobs, CeilingJob(trials, out, scene), *tests]


def _trials_in(scene: Scene, budget: Budget) -> tuple[Trials, ...]:
    """Return the tests of a budget in a scene.

    Raises:
        InputError: there are the same conditions twice, whose cases would count as those of more seeds.
    """
    trials = tuple(trials.relative_to(scene.tau_s) for trials in budget.trials)
    counts = Counter(conditions for one in trials for conditions in one.conditions)
    for conditions, count in counts.items():
        if count > 1:
            raise InputError(
                f"trials must have each conditions once, not P(conservative) {conditions.p_conservative.text} "
                f"{conditions.label} {count} times; a headway of {scene.tau_s:g} s is that of the scene's drivers"
            )
    return trials


def _require_tests(mixes: Sequence[Mix], trials: Sequence[Trials]) -> None:
    """Raise InputError unless policies that are trained at each of the mixes are tested somewhere."""
    tested = [conditions.p_conservative for one in trials for conditions in one.conditions]
    for mix in mixes:
        if not any(map(mix.contains, tested)):
            raise InputError(
                f"mixes: policies trained at {mix.text} are tested nowhere; give trials with p_conservative "
                f"{mix.text}, or leave this mix out"
            )


def run_study(
    budget: Budget, out: Path, *, scene: str | Scene = T_INTERSECTION, workers: Workers = 2, progress: bool = True
) -> StudyReport:
    """Run the study into ``out``; what an earlier, interrupted call has finished is not repeated.

    Args:
        budget: sizes of all stages.
        out: a new folder, or the one of this very study.
        scene: where everybody drives; the shipped policies, which know the paper's scene, are tested there alone.
        workers: processes at a time, or an executor.
        progress: show the progress on stderr.

    Raises:
        InputError: ``out`` holds another run, the scene does not fit the budget, or a stage was refused.
        JobError: jobs were given up; all others are done.
    """
    executor = executor_of(workers)
    base = require_scene("a study", find_scene(scene))
    found = budget.trained_in(base)
    jobs = plan(budget, out, base)
    scene_entries = {} if found == paper_scene() else described([found])
    with claim_folder(out, {"kind": "study", **plain(budget), **scene_entries}):
        if budget.traits is not None:
            record(
                out / DATASET,
                budget.windows,
                p_conservative=budget.record_p_conservative,
                seed=SEED,
                scene=found,
                workers=executor,
                progress=progress,
            )
        executor.run(jobs, progress)
        return write_page(write_report(out), out, workers=executor, progress=progress)


def require_scene(work: str, scene: AnyScene) -> Scene:
    """Return the scene, if this work, such as ``"a study"``, can be done there.

    Raises:
        InputError: it cannot.
    """
    found = require_built_in(work, scene)
    require_two_kinds(len(found.traits), work, f"scene {found.name}")
    return found


def require_traits(methods: Sequence[str], scene: Scene, remedy: str) -> None:
    """Raise InputError, which ends with a remedy, if a method takes a shipped trait model that is not of the scene."""
    inferring = [name for name in methods if find_learned(name).encoder]
    if inferring and scene.digest != paper_scene().digest:
        raise InputError(
            f"{', '.join(inferring)}: the shipped trait models know the scene {T_INTERSECTION}, not {scene.name}; "
            f"{remedy}"
        )
