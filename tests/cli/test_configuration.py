"""Configuration files: what commands read from them, and what they print."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.cli.calls import refuse, run
from tests.scenes.networks import UserNetwork
from tint_sumo.cli.command_line import TintSumo, main, parse
from tint_sumo.cli.configuration import commands_named, subcommands
from tint_sumo.config import Mix
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import load_drivers, load_labels, load_windows
from tint_sumo.scenes import Scene, read_scene
from tint_sumo.study.budgets import BUDGETS
from tint_sumo.study.ceiling_job import CeilingJob
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.plan import plan, run_study

# A command line for each command, with as many flags as it has kinds of values.
COMMAND_LINES = (
    "net build --replicas 3 --scene four_way --out some/net",
    "net import map.xodr --out some/net --format lanelet2 --left-hand true --origin 49 -8.4 --overwrite",
    "scene check mine.sumocfg --ego-route in out --start-m 3.5 --goal-m 90 --figure picture.svg",
    "scene check mine.sumocfg --ego-route in out --goal-m 90 --perceives lane pedestrians --red-light end",
    "record --out data --windows 70 --p-conservative 0.2 0.8 --population continuous --format fcd --json",
    "record --out data --sumocfg mine.sumocfg",
    "record --out s3://bucket/data --executor ray --address ray://head:10001",
    "dataset inspect data --figure picture.png --verify",
    "tracks inspect tracks.csv --format ngsim --figure tracks.png",
    "tracks match tracks.csv map.net.xml --out matched.parquet --figure matched.png --shift-m -100 2.5",
    "drivers fit tracks --out fitted --model EIDM --min-duration 15 --step 0.2",
    "drivers export fitted --out drivers --size 20 --seed 3 --speed-limit 27.8",
    "drivers check fitted --recording tracks --repeats 2 --seed 3 --speed-limit 27.8 --format levelx",
    "traits train --data data --out model --method morton --budget paper --noise 0.1",
    "traits relative --out relative.yaml --world towns --test old eidm --scene four_way --seed 3",
    "traits evaluate --data data --model vae --noise 1e-3 --other-scene",
    "traits plot --data data --model vae --out pictures",
    "traits infer --fcd data --model vae --out table.csv --vehicle-length 4.5",
    "traits train --tracks tracks --fit fitted --out model --method cross_window --format leader_follower",
    "traits infer --tracks tracks --model model --out table.csv",
    "traits export --model vae --out folder --onnx",
    "traits identify --tracks tracks --model model",
    "traits study --workers 1",
    "policy train --method oracle --out run --steps 10 --budget quick --scene all --zip",
    "policy train --method oracle --out run --p-conservative 0.4",
    "policy train --method no_labels --out run --sumocfg mine.sumocfg --ego-route a b --goal-m 90.5 --speeds-mps 0 5 9",
    "policy train --method no_labels --out run --sumocfg a.sumocfg --ego-route a --goal-m 9 --perceives lane",
    "policy evaluate --model ttc --sumocfg mine.sumocfg --ego-route a b --goal-m 90.5 --red-light cost",
    "policy evaluate --model ttc --p-conservative 0.1 0.9 --scene roundabout --tau 1.5",
    "policy evaluate --model no",
    "policy evaluate --model ttc --sensor range_15",
    "policy train --method oracle --out run --sensor occlusion",
    "policy record --model ttc --minari ttc-v0 --out minari --episodes 7 --random-actions 0.1 --author Ada --workers 2",
    "policy export --model streaming --out folder --onnx --scene on_ramp",
    "policy sweep --set learning_rate=1e-3,3e-3 n_epochs=2,4 --out s3://bucket/sweep --methods oracle ma --seeds 0 1",
    "study run --budget full --scene on_ramp --workers 3",
    "study report --out runs/full",
    "study log train-oracle --out runs/full",
    "study scenes",
    "render --model oracle --out film.gif --case 3 --sensor delay_0.2",
    "bench --quick",
    "models vae",
)


# A billion values by aliases of aliases.
LAUGHS = "a0: &a0 [x]\n" + "\n".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 10))
MERGED_LAUGHS = "a0: &a0 {x: 1}\n" + "\n".join(
    f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, 10)
)


def printed(capsys: pytest.CaptureFixture[str], *words: Any) -> str:
    """The configuration that a command line prints."""
    assert main([*map(str, words), "--print-config"]) == 0
    return capsys.readouterr().out


def written(folder: Path, text: str, name: str = "config.yaml") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


# From flags to a file and back


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_a_printed_configuration_is_the_same_as_the_flags(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = line.split()
    names = words[: len(commands_named(TintSumo, words)) - 1]
    text = printed(capsys, *words)
    file = written(tmp_path, text)
    assert replace(parse([*names, "--config", str(file)]), config=None) == parse(words)
    assert printed(capsys, *names, "--config", file) == text


def test_every_command_has_a_line_here() -> None:
    assert {tuple(commands_named(TintSumo, line.split())) for line in COMMAND_LINES} == set(all_commands(TintSumo))


def all_commands(*groups: type) -> Iterator[tuple[type, ...]]:
    """Every command behind the groups that it is in."""
    below = subcommands(groups[-1])
    if not below:
        yield groups
    for kind in below.values():
        yield from all_commands(*groups, kind)


# Flags and files together


def test_flags_win_over_the_file(tmp_path: Path) -> None:
    file = str(written(tmp_path, "out: here\nwindows: 50\nseed: 7\njson: true\np_conservative: [0.2, 0.8]"))
    found = parse(["record", "--config", file, "--seed", "3", "--json", "--out", "there"])
    assert (found.out, found.windows, found.seed, found.p_conservative) == ("there", 50, 3, (0.2, 0.8))
    assert parse(["record", f"--config={file}", "--no-json"]).json is False


def test_the_home_folder_is_found_where_no_shell_puts_it_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    written(tmp_path, 'out: ~/data\nsumocfg: "~/mine.sumocfg"')
    found = parse(["record", "--config=~/config.yaml"])
    assert (found.out, found.sumocfg) == (str(tmp_path / "data"), tmp_path / "mine.sumocfg")
    assert parse(["record", "--out", "~data"]).out == "~data"


def test_what_must_be_given_may_come_from_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(written(tmp_path, "method: oracle"))
    with pytest.raises(SystemExit) as stop:
        parse(["policy", "train", "--config", file])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "--out" in message
    assert "--method" not in message
    assert parse(["policy", "train", "--config", file, "--out", "run"]).method == "oracle"


def test_an_empty_file_and_numbers_with_exponents(tmp_path: Path) -> None:
    text = "# nothing but a comment\n"
    assert parse(["bench", "--config", str(written(tmp_path, text))]) == replace(
        parse(["bench"]), config=tmp_path / "config.yaml"
    )
    budget = "budget: {learning_rate: 1e-3, n_envs: 8}\nmethod: oracle\nout: run"
    found = parse(["policy", "train", "--config", str(written(tmp_path, budget))]).budget
    assert found == replace(BUDGETS["full"].ppo, learning_rate=0.001, n_envs=8)


def test_one_value_stands_for_a_list_of_it(tmp_path: Path) -> None:
    text = "p_conservative: 0.4\nbudget: {seeds: 3, methods: oracle, mixes: [0.5, [0.1, 0.9]]}"
    assert parse(["record", "--out", "x", "--config", str(written(tmp_path, text[:20]))]).p_conservative == (0.4,)
    budget = parse(["study", "run", "--config", str(written(tmp_path, text[20:]))]).budget
    assert (budget.seeds, budget.methods, budget.mixes) == ((3,), ("oracle",), (Mix(0.5), Mix(0.1, 0.9)))


def test_a_budget_equal_to_a_known_one_is_that_one(tmp_path: Path) -> None:
    assert parse(["study", "run", "--config", str(written(tmp_path, "budget: {base: full}"))]).budget == "full"
    other = parse(["study", "run", "--config", str(written(tmp_path, "budget: {seeds: [4]}"))]).budget
    assert other == replace(BUDGETS["quick"], seeds=(4,))


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        (
            "record",
            "out: data\nwindow: 5",
            "line 2: window: there is no such setting; did you mean windows?; known are json, executor",
        ),
        ("record", "windows: many", "line 1: windows: must be a whole number from 1 to 100,000,000, not 'many'"),
        ("record", "windows: 1.5", "line 1: windows: must be a whole number from 1 to 100,000,000, not 1.5"),
        ("record", "windows: true", "line 1: windows: must be a whole number from 1 to 100,000,000, not True"),
        ("record", "out: null", "line 1: out: must be text, not None"),
        ("record", "format: xml", "line 1: format: must be one of parquet, fcd, not 'xml'"),
        (
            "record",
            "p_conservative: x",
            "line 1: p_conservative: must be a list, each item a number from 0",
        ),
        ("record", "p_conservative:\n- 0.1\n- x", "line 3: p_conservative[1]: must be a number from 0 to 1, not 'x'"),
        ("record", "seed: 1\nout: a\nseed: 2", "line 3: seed is said twice"),
        ("record", "seed: [", "line 1: not YAML that can be read ("),
        ("record", "out: {{name}}", "not YAML that can be read (found unhashable key)"),
        ("record", "out: &a [*a]", "not YAML that can be read (maximum recursion depth"),
        ("record", "out: a\x00b", "not YAML that can be read (unacceptable character #x0000"),
        ("record", "out: !!python/name:os.system x", "could not determine a constructor for the tag"),
        ("record", "out: 2020-13-45\nwindow: 1", "line 2: window: there is no such setting"),  # a date would be text
        ("record", "out: !!timestamp 2020-13-45", "could not determine a constructor for the tag"),
        ("record", f"windows: {'9' * 5000}", "line 1: a number has more than 60 digits; give fewer"),
        ("record", f"windows: 0x{'f' * 5000}", "line 1: a number has more than 60 digits; give fewer"),
        ("record", "windows: !!int ''", "not YAML that can be read"),
        ("record", "windows: !!bool perhaps", "not YAML that can be read"),
        ("record", 'seed: 1\nout: "a\\0b"', "line 2: 'a\\x00b' has a character that is no text; leave it out"),
        ("record", 'out: "\\ud800"', "has a character that is no text; leave it out"),
        ("record", "out: " + "[" * 3000, "not YAML that can be read"),
        ("record", LAUGHS, "line 1: more than 20,000 values; leave out what is there by aliases"),
        ("record", MERGED_LAUGHS, "line 1: more than 20,000 values; leave out what is there by aliases"),
        ("record", "# " + "x" * 200_000, "has 200,002 bytes, more than the 131,072 that are read; check the path"),
        ("record", "- seed", "must hold a mapping, lines such as 'seed: 1', not list"),
        ("record", "config: other.yaml", "line 1: config: there is no such setting"),
        ("record", "scene: moon", "line 1: scene: is not known: 'moon'; choose one of: four_way, "),
        ("record", "scene: 3", "line 1: scene: must be a name (four_way, "),
        ("record", "scene:\n  base: fourway", "line 2: scene.base: is not known: 'fourway'; did you mean four_way?"),
        ("record", "scene:\n  claim:\n    brakes: 2", "line 3: scene.claim.brakes: there is no such setting"),
        ("record", "scene: {network: {}}", "line 1: scene.network: there is no such setting; known are base, name"),
        ("record", "scene: {name: four_way}", "line 1: scene: name must not be that of a built-in scene, four_way"),
        (
            "record",
            "scene: {start_m: 50}",
            "line 1: scene: the ego's goal (34.6982 m) must lie beyond its start (50 m)",
        ),
        ("record", "scene:\n  max_vehicles: 0", "line 2: scene.max_vehicles: must lie in 1 to 200, not 0"),
        ("record", "scene: {arrivals_per_s: -1}", "line 1: scene.arrivals_per_s: must lie in 1e-06 to 100, not -1"),
        ("record", "scene:\n  sumocfg: nowhere.sumocfg", "line 1: scene: ego_route, start_m, goal_m must be given"),
        (
            "record",
            "population: [{name: a}]",
            "line 1: population[0]: desired_speed_mps, min_gap_m, entry_gap_m, yields",
        ),
        (
            "record",
            "population: {idm: {tau_s: 0}}\nout: x",
            "line 1: population.idm.tau_s: must lie in 0.01 to 20, not 0.0",
        ),
        ("record", "population: {members: 0}", "line 1: population.members: must lie in 1 to 10,000, not 0"),
        ("policy train", "budget: {ppo: {}}", "line 1: budget.ppo: there is no such setting; known are n_envs"),
        ("policy train", "budget: {gamma: 2}", "line 1: budget.gamma: must lie in 0 to 1, not 2.0"),
        ("policy train", "budget: {n_envs: 4}", "line 1: budget: n_minibatches must be at most n_envs (4)"),
        ("study run", "budget:\n  ppo:\n    n_envs: 0", "line 3: budget.ppo.n_envs: must lie in 1 to 4,096, not 0"),
        ("study run", "budget:\n  seeds: []", "line 1: budget: seeds must be one or more, each of them once, not []"),
        ("study run", "budget:\n  windows: 0", "line 1: budget: windows must be at least 1, not 0"),
        ("study run", "budget: {trials: [{episodes: 3}]}", "line 1: budget.trials[0]: conditions must be given"),
        ("study run", "budget: {methods: [magic]}\nout: x", "unknown method 'magic'; choose one of"),
        ("study run", "budget: {seeds: [1]}", "a budget without a name needs a folder; give it with --out"),
        ("study run", "scene: all\nout: x", "unknown scene 'all'"),
        (
            "traits study",
            "budget: {windows: x}",
            "line 1: budget.windows: must be a whole number from 1",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(
    command: str,
    text: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    file = written(tmp_path, text)
    error = refuse(capsys, *command.split(), "--config", file)
    assert message in error
    assert str(file) in error or "out: x" in text or "needs a folder" in error
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_missing_and_unreadable_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = f"configuration: no file {tmp_path / 'no.yaml'}; check the path"
    assert refuse(capsys, "bench", "--config", tmp_path / "no.yaml") == message
    (tmp_path / "binary.yaml").write_bytes(b"\xff\x00")
    assert "is not a text file" in refuse(capsys, "bench", "--config", tmp_path / "binary.yaml")


# Definitions in configuration files

DRIVERS = """
population:
- {name: shy, desired_speed_mps: [1.5, 2], min_gap_m: [2, 3], entry_gap_m: [6, 8], yields: true, colour: "0,0,200"}
- {name: calm, desired_speed_mps: [2, 3], min_gap_m: [1, 2], entry_gap_m: [4, 6], yields: true, colour: "0,200,0"}
- {name: bold, desired_speed_mps: [3, 4], min_gap_m: [0.2, 0.5], entry_gap_m: [3, 5], yields: false, colour: "200,0,0"}
"""
SMALL = "budget: {n_envs: 2, n_steps: 8, n_minibatches: 1}\nsteps: 1\nout: run\n"


def test_drivers_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    manifest = run(capsys, "record", "--config", written(tmp_path, DRIVERS), "--windows", 20, "--out", out)
    assert [profile["name"] for profile in manifest["population"]["profiles"]] == ["shy", "calm", "bold"]
    windows = load_windows(out)
    names = load_drivers(out, windows, ["trait"])["trait"]
    assert set(names) == {"shy", "calm", "bold"}
    assert [("shy", "calm", "bold")[label] for label in load_labels(out, windows)] == list(names)
    found = run(capsys, "dataset", "inspect", out)["traits"]
    assert found["shy"]["speed_mps"]["max"] <= 2.0 < found["bold"]["speed_mps"]["max"]
    assert "holds another run (different: population)" in refuse(capsys, "record", "--windows", 20, "--out", out)


def test_a_trait_model_of_another_scene_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = written(tmp_path, "scene: {claim: {braking_mps2: 4}, name: hasty}")
    out = tmp_path / "data"
    assert run(capsys, "record", "--config", scene, "--windows", 20, "--out", out)["scene"] == "hasty"
    message = "trait model vae was trained in scene t_intersection"
    assert message in refuse(capsys, "traits", "evaluate", "--data", out, "--model", "vae")
    train = written(tmp_path, f"method: vae\n{SMALL}{scene.read_text()}", "train.yaml")
    argv = ("policy", "train", "--config", train, "--out", tmp_path / "run")
    assert "the policy is of scene hasty" in refuse(capsys, *argv)
    assert not (tmp_path / "run").exists()


def test_a_policy_drives_in_the_scene_that_it_was_trained_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = "scene: {base: four_way, name: small, max_vehicles: 4, time_limit_s: 2, population: {idm: {tau_s: 2}}}"
    file = written(tmp_path, f"method: oracle\n{SMALL}{scene}")
    run(capsys, "policy", "train", "--config", file)
    found = run(capsys, "policy", "evaluate", "--model", "run", "--episodes", 2)
    assert (found["scene"], found["tau_s"]) == ("small", 2.0)
    message = "policy run needs max_vehicles of 4, and scene four_way has 12"
    assert message in refuse(capsys, "policy", "evaluate", "--model", "run", "--scene", "four_way")
    written(tmp_path, scene)
    found = run(capsys, "policy", "evaluate", "--model", "always_go", "--config", file, "--episodes", 2)
    assert (found["scene"], found["timeout"]) == ("small", 1.0)
    assert run(capsys, "render", "--model", "run", "--out", "film.png")["time_s"] == 2.0
    assert run(capsys, "render", "--model", "ttc", "--config", file, "--out", "other.png")["scene"] == "small"


def test_policies_and_films_of_other_drivers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = "scene:\n  name: three\n  time_limit_s: 1\n" + DRIVERS.replace("\n", "\n  ")
    file = written(tmp_path, SMALL + scene)
    message = "method oracle needs exactly two kinds of drivers, and scene three has 3"
    assert message in refuse(capsys, "policy", "train", "--method", "oracle", "--config", file)
    run(capsys, "policy", "train", "--method", "no_labels", "--config", file)
    assert "a film needs exactly two kinds of drivers" in refuse(
        capsys, "render", "--model", "run", "--out", "film.png"
    )
    study = ("study", "run", "--config", written(tmp_path, scene), "--out", "study")
    assert "a study needs exactly two kinds of drivers, and scene three has 3" in refuse(capsys, *study)
    assert not Path("study").exists()


def test_a_sumo_configuration_as_a_scene(
    user_network: Callable[[str], UserNetwork],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    merge = user_network("merge")
    scene = (
        f"scene:\n  sumocfg: {merge.sumocfg}\n  ego_route: [ramp, out]\n  start_m: 20\n  goal_m: 130\n"
        "  warm_up_s: 1\n  time_limit_s: 1\n"
    )
    file = written(tmp_path, scene)
    manifest = run(capsys, "record", "--config", file, "--windows", 20, "--out", "data")
    assert manifest["population"] == ["calm", "hasty"]
    argv = ("record", "--config", file, "--population", "traits", "--out", "other")
    assert "--population does not go with the sumocfg of a scene" in refuse(capsys, *argv)
    one = SMALL.replace("n_envs: 2", "n_envs: 1")  # each has a process of its own
    train = written(tmp_path, one + scene, "train.yaml")
    run(capsys, "policy", "train", "--method", "oracle", "--config", train)
    found = run(capsys, "policy", "evaluate", "--model", "run", "--episodes", 1)
    assert (found["scene"], found["p_conservative"], found["timeout"]) == ("merge", None, 1.0)
    argv = ("policy", "train", "--method", "oracle", "--config", train, "--out", "new", "--p-conservative", 0.2)
    assert "leave p_conservative out" in refuse(capsys, *argv)
    evaluation = ("policy", "evaluate", "--episodes", 1, "--model")
    assert "leave tau_s out" in refuse(capsys, *evaluation, "run", "--tau", 2)
    assert run(capsys, *evaluation, "ttc", "--config", file)["scene"] == "merge"
    assert run(capsys, "render", "--model", "run", "--out", "film.gif")["outcome"] == "timeout"
    assert "a study needs a built-in scene" in refuse(capsys, "study", "run", "--out", "study", "--config", file)
    assert "a network needs a built-in scene" in refuse(capsys, "net", "--config", file)


def test_all_of_a_study_is_in_its_scene(tmp_path: Path) -> None:
    scene = read_scene({"base": "four_way", "time_limit_s": 20})
    assert isinstance(scene, Scene)
    budget = replace(BUDGETS["quick"], methods=("ttc", "oracle"))
    jobs = plan(budget, tmp_path, scene)
    placed = [job.scene for job in jobs if isinstance(job, TrainJob | EvaluateJob | CeilingJob)]
    assert placed == [scene] * len(jobs)
    assert not any("shipped" in job.name for job in jobs)  # they know another scene
    with pytest.raises(InputError, match="the shipped trait models know the scene t_intersection, not four_way-"):
        shipped = replace(budget, methods=("ttc", "vae"), traits=None, windows=0)
        run_study(shipped, tmp_path / "out", scene=scene, progress=False)
    assert not (tmp_path / "out").exists()
