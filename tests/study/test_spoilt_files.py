"""Files of runs with one value spoilt: they are read, or refused in one line; nothing else may happen."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tests.study.scenes import trained
from tint_sumo import traits
from tint_sumo.comparisons import traits_report
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import RUN_FILE, claim_folder, shipped, write_json
from tint_sumo.core.progress import silent
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.schema import read_manifest
from tint_sumo.methods.loading import load_policy
from tint_sumo.policy.storage import read_versions
from tint_sumo.scenes import described, find_scene
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.ceiling_job import CEILINGS_FILE, read_ceilings
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.page.recording import Recording, read_episodes
from tint_sumo.study.results import Result
from tint_sumo.study.settings import read_scene_of
from tint_sumo.traits.evaluation import Part, TraitAccuracy
from tint_sumo.traits.storage import add_to_card, require_scene

DEEP = "nested"  # stands for lists in lists, which json cannot write
VALUES = ([], {}, "x", -1, float("nan"), 1e300, None, DEEP, True, 10**400)


def spoilt(content: Any) -> Iterator[Any]:
    """The content with each value in turn replaced, left out, or with another one beside it; of lists the first."""
    yield from VALUES
    if isinstance(content, dict):
        yield {**content, "an entry": 1}
        for key in content:
            yield {name: value for name, value in content.items() if name != key}
            for one in spoilt(content[key]):
                yield {**content, key: one}
    elif isinstance(content, list) and content:
        yield [*content, "x"]
        for one in spoilt(content[0]):
            yield [one, *content[1:]]


def check(file: Path, read: Callable[[], Any]) -> list[str]:
    """Spoil a file in all ways; the refusals."""
    read()
    refusals = []
    for one in spoilt(json.loads(file.read_text())):
        text = json.dumps(one)
        file.write_text(text.replace(f'"{DEEP}"', "[" * 10_000 + "]" * 10_000))
        try:
            read()
        except InputError as error:
            refusals.append(str(error))
            assert "\n" not in str(error), text
        except Exception as error:
            raise AssertionError(f"{text[:2000]}: {error!r}") from error
    assert len(refusals) > len(VALUES)
    return refusals


def test_results(tmp_path: Path) -> None:
    file = tmp_path / "result.json"
    write_json(file, trained("oracle", 1, {Conditions(ALL_MIXES, 0.05, 0.7, 25): (3, 0, 2)}).to_json())
    refusals = check(file, lambda: Result.read(file))
    assert all("result.json is damaged" in one for one in refusals)
    assert any("tested[0].tau_s: must be" in one for one in refusals)
    assert any("an entry: there is no such setting" in one for one in refusals)


def test_ceilings(tmp_path: Path) -> None:
    write_json(tmp_path / CEILINGS_FILE, {"0.4": 0.9, "0.6": 1.0})
    check(tmp_path / CEILINGS_FILE, lambda: read_ceilings(tmp_path))


def test_recorded_episodes(tmp_path: Path) -> None:
    recording = Recording("always_go", None, 0, Conditions(Mix(0.4)), (0,), tmp_path)
    recording.make(silent)
    content = json.loads(recording.file.read_text())
    del content["episodes"]["0"]["vehicles"][1:], content["episodes"]["0"]["vehicles"][0]["x_m"][1:]
    written = json.dumps(content).encode()
    recording.file.write_bytes(written)
    check(recording.file, lambda: read_episodes(recording.file))
    recording.file.write_bytes(written)
    check(recording.file, recording.is_done)


@pytest.mark.parametrize("kind", ["comparison", "continuous"])
def test_results_of_trait_studies(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traits_report, "plot_noise", lambda *_: None)
    found = TraitAccuracy(0.9, 0.9, 0.5, 10, None, None, {"2-5": Part(0.9, 10)}, {"with_leader": Part(None, 0)})
    case = {"kind": "comparison", "method": "vae", "noise_m": 0.0, "seed": 0, "training_windows": 20, "training_s": 1.0}
    write_json(tmp_path / RESULTS / "comparison.json", {**case, **asdict(found), "by_p": {"0.4": 1.0}})
    continuous = {"kind": "continuous", "method": "vae", "latent_size": 2, "seed": 0, "r2": {"min_gap_m": 0.5}}
    write_json(tmp_path / RESULTS / "continuous.json", continuous)
    check(tmp_path / RESULTS / f"{kind}.json", lambda: traits_report.write_trait_report(tmp_path))


def test_settings_of_runs(tmp_path: Path) -> None:
    settings = {"kind": "study", **described([find_scene("roundabout")]), "budget": "quick", "numbers": [1, {"a": 2}]}
    out = tmp_path / "run"

    def read() -> None:
        with claim_folder(out, settings):
            pass

    read()
    refusals = check(out / RUN_FILE, read)
    assert any("already holds another run (different: numbers)" in one for one in refusals)
    write_json(out / RUN_FILE, settings)
    check(out / RUN_FILE, lambda: read_scene_of(out))


def test_cards_of_trait_models(tmp_path: Path) -> None:
    for suffix in (".json", ".safetensors"):
        shutil.copyfile(shipped("models") / f"vae{suffix}", tmp_path / f"model{suffix}")

    def read() -> None:
        traits.load(tmp_path)
        require_scene(tmp_path, "roundabout", "0123", "the dataset")

    with pytest.raises(InputError, match="was trained in scene t_intersection"):
        read()
    add_to_card(tmp_path, {"data": {"scene": "roundabout", "scene_digest": "0123"}})
    check(tmp_path / "model.json", read)


def test_cards_of_policies(tmp_path: Path) -> None:
    for suffix in (".json", ".safetensors"):
        shutil.copyfile(shipped("models") / "policies" / f"oracle{suffix}", tmp_path / f"policy{suffix}")
    card = json.loads((tmp_path / "policy.json").read_text())
    needed = {"method", "p_conservative", "scene", "scene_digest", "steps", "seed", "traits", "settings", "network"}
    needed |= {"weights_sha256"}
    card = {key: value for key, value in card.items() if key in needed}  # the rest may say anything
    card["settings"] = {"action_repeat": card["settings"]["action_repeat"]}
    card["versions"] = {"torch": "2"}
    write_json(tmp_path / "policy.json", card)
    check(tmp_path / "policy.json", lambda: (read_versions(tmp_path / "policy"), load_policy(tmp_path)))


def test_manifests_of_datasets(tmp_path: Path) -> None:
    """Read by all that take a dataset, and by a recording that goes on."""
    settings: Any = {"windows": 1, "population": "traits", "seed": 3, "workers": 1, "progress": False}
    record(tmp_path / "data", **settings)
    file = tmp_path / "data" / "manifest.json"
    manifest = json.loads(file.read_text())
    check(file, lambda: read_manifest(tmp_path / "data"))
    for shards in ([], "x", -1, None, 1e300):
        write_json(file, {**manifest, "shards": shards})
        with pytest.raises(InputError, match=r"manifest\.json is damaged \(shards: must"):
            record(tmp_path / "data", **settings)
