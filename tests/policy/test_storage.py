import json
import pickle
import resource
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file

from tests.bombs import BOMBS, bomb
from tests.simulation.scenes import T
from tint_sumo.config import PolicySettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.core.weights import SHA256, card_file, weights_file, write_weights
from tint_sumo.envs.episodes import action_space, observation_space
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.storage import load_policy_network, read_policy_card, save_policy
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS, trait_space

from .tasks import SMALL


def make(trait_size: int = 2, *, informed_critic: bool = False, settings: PolicySettings = SMALL) -> GruPolicy:
    """A policy of a T-intersection that nobody trained."""
    parts = {**observation_space(12).spaces, TRAITS: trait_space(12, trait_size)}
    if informed_critic:
        parts[TRUE_TRAITS] = trait_space(12, 2)
    torch.manual_seed(0)
    return GruPolicy(spaces.Dict(parts), action_space(T), lambda _: 1e-3, settings=settings)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A saved policy, without suffix."""
    save_policy(make(), tmp_path / "run" / "policy", {"method": "oracle"})
    return tmp_path / "run" / "policy"


def scenes(trait_size: int) -> list[dict[str, np.ndarray]]:
    """Streets one after the other; the last axis of traits has this size."""
    rng = np.random.default_rng(0)
    return [
        {
            "ego": rng.normal(size=(32, 4)).astype(np.float32),
            "vehicles": rng.normal(size=(32, 12, 2)).astype(np.float32),
            "mask": (rng.random((32, 12)) < 0.6).astype(np.float32),
            "traits": rng.normal(size=(32, 12, trait_size)).astype(np.float32),
        }
        for _ in range(5)
    ]


def drive(policy: GruPolicy, trait_size: int) -> list[np.ndarray]:
    """Actions and hidden states along the scenes."""
    seen, state = [], None
    for observation in scenes(trait_size):
        actions, state = policy.predict(observation, state, deterministic=True)
        seen += [actions, state[0]]
    return seen


@pytest.mark.parametrize(
    "features",
    [
        {},
        {"trait_size": 5},
        {"trait_size": 5, "informed_critic": True},
        {"settings": PolicySettings((8,), (), 8, (8,), 8, (), attention=False, position_gain=6.0)},
    ],
)
def test_a_saved_policy_acts_as_before(tmp_path: Path, features: dict[str, Any]) -> None:
    policy = make(**features)
    save_policy(policy, tmp_path / "policy", {})
    loaded = load_policy_network(tmp_path / "policy")
    size = features.get("trait_size", 2)
    for before, after in zip(drive(policy, size), drive(loaded, size), strict=True):
        np.testing.assert_array_equal(before, after)
    assert loaded.settings == policy.settings
    for name, weights in policy.state_dict().items():
        assert torch.equal(weights, loaded.state_dict()[name])


def test_actions_depend_on_what_is_seen_so_that_the_comparison_means_something() -> None:
    assert len(set(np.concatenate(drive(make(), 2)[::2]).tolist())) > 1


def test_a_loaded_policy_is_for_driving(saved: Path) -> None:
    policy = load_policy_network(saved)
    assert not policy.training
    assert not any(parameter.requires_grad for parameter in policy.parameters())


def test_every_weight_is_stored_once(saved: Path) -> None:
    numbers = sum(parameter.numel() for parameter in make().parameters())
    assert 4 * numbers < weights_file(saved).stat().st_size < 4 * numbers + 8192
    assert sorted(path.name for path in saved.parent.iterdir()) == ["policy.json", "policy.safetensors"]


def test_the_card_keeps_its_entries_and_describes_the_network(saved: Path) -> None:
    card = read_policy_card(saved)
    assert card["method"] == "oracle"
    assert card["network"]["trait_size"] == 2
    assert card["network"]["critic_sees_true_traits"] is False
    assert (card["network"]["max_vehicles"], card["network"]["actions"]) == (12, 3)
    assert card["network"]["settings"]["hidden_size"] == SMALL.hidden_size


def test_the_card_names_what_is_observed_of_the_road(tmp_path: Path) -> None:
    save_policy(make(), tmp_path / "plain", {})
    assert "perceives" not in read_policy_card(tmp_path / "plain")["network"]
    parts = {**observation_space(12, ("traffic_light", "lane")).spaces, TRAITS: trait_space(12, 2)}
    policy = GruPolicy(spaces.Dict(parts), action_space(T), lambda _: 1e-3, settings=SMALL)
    save_policy(policy, tmp_path / "road", {})
    loaded = load_policy_network(tmp_path / "road")
    assert loaded.observation_space == policy.observation_space
    card = json.loads(card_file(tmp_path / "road").read_text())
    card["network"]["perceives"] = ["lane"]
    card_file(tmp_path / "road").write_text(json.dumps(card))
    with pytest.raises(InputError, match=r"road\.json"):
        load_policy_network(tmp_path / "road")


def test_names_may_have_dots(tmp_path: Path) -> None:
    save_policy(make(), tmp_path / "vae-P0.4", {})
    assert {path.name for path in tmp_path.iterdir()} == {"vae-P0.4.json", "vae-P0.4.safetensors"}
    load_policy_network(tmp_path / "vae-P0.4")


def test_where_there_is_a_card_there_are_weights(tmp_path: Path) -> None:
    weights_file(tmp_path / "policy").mkdir()  # so that the weights cannot be written
    with pytest.raises(OSError, match="directory"):
        save_policy(make(), tmp_path / "policy", {})
    assert [path.name for path in tmp_path.iterdir()] == ["policy.safetensors"]


def refused(stem: Path) -> str:
    """The one line that says what is wrong and what to do."""
    with pytest.raises(InputError) as refusal:
        load_policy_network(stem)
    line = str(refusal.value)
    assert "\n" not in line
    assert str(stem) in line
    assert any(advice in line for advice in ("restore", "make it anew", "check the path"))
    return line


@pytest.mark.parametrize("kept", [0, 4, 200, -50])
def test_damaged_weights_are_reported(saved: Path, kept: int) -> None:
    file = weights_file(saved)
    file.write_bytes(file.read_bytes()[:kept])
    assert "policy.safetensors is damaged" in refused(saved)


def test_weights_are_compared_with_the_checksum_of_the_card(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = bytearray(weights_file(saved).read_bytes())
    content[-1] ^= 1  # of the last number
    weights_file(saved).write_bytes(content)
    assert "policy.safetensors is damaged: it has another checksum than policy.json says" in refused(saved)
    card = read_policy_card(saved)
    del card[SHA256]
    card_file(saved).write_text(json.dumps(card))
    load_policy_network(saved)
    assert "policy.json has no checksum of the weights, which are not verified" in capsys.readouterr().err


def test_weights_that_are_not_finite_are_refused(saved: Path) -> None:
    weights = load_file(weights_file(saved))
    name = sorted(weights)[0]
    weights[name].view(-1)[0] = float("nan")
    card_file(saved).write_text(json.dumps({**read_policy_card(saved), **write_weights(saved, weights)}))
    assert f"has numbers that are not finite in {name}" in refused(saved)


def test_no_memory_is_taken_for_a_network_that_its_weights_do_not_have(saved: Path) -> None:
    card = read_policy_card(saved)
    card["network"]["settings"] |= {"embedding_sizes": [2048] * 8, "score_sizes": [2048] * 8, "hidden_size": 2048}
    card_file(saved).write_text(json.dumps(card))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "does not fit the weights beside it" in refused(saved)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB; the network would have 400,000


def test_missing_files_are_reported(saved: Path) -> None:
    weights_file(saved).unlink()
    assert f"no file {weights_file(saved)}" in refused(saved)
    card_file(saved).unlink()
    assert f"no file {card_file(saved)}" in refused(saved)


def test_weights_of_another_network_are_reported(saved: Path, tmp_path: Path) -> None:
    save_policy(make(trait_size=5), tmp_path / "other", {})
    shutil.copyfile(weights_file(tmp_path / "other"), weights_file(saved))
    assert "policy.json does not fit the weights beside it" in refused(saved)
    shutil.copyfile(shipped("models") / "vae.safetensors", weights_file(saved))
    assert "policy.json does not fit the weights beside it" in refused(saved)


def test_a_card_of_something_else_is_reported(saved: Path) -> None:
    shutil.copyfile(shipped("models") / "vae.json", card_file(saved))
    assert "policy.json is not the card of a policy" in refused(saved)


@pytest.mark.parametrize("text", ["", "{", "[]", "\0"])
def test_an_unreadable_card_is_reported(saved: Path, text: str) -> None:
    card_file(saved).write_text(text)
    assert "policy.json is damaged" in refused(saved)


@pytest.mark.parametrize(
    "network",
    [
        {"settings": None},
        {"settings": [1]},
        {"settings": {"depth": 3}},
        {"settings": {"embedding_sizes": []}},
        {"settings": {"embedding_sizes": -5}},
        {"settings": {"embedding_sizes": ["many"]}},
        {"settings": {"hidden_size": -1}},
        {"settings": {"hidden_size": 10**12}},
        {"trait_size": "two"},
        {"trait_size": -2},
        {"trait_size": 10**13},
        {"trait_size": None},
        {"max_vehicles": "many"},
        {"max_vehicles": -1},
        {"actions": 0},
        {"actions": None},
    ],
)
def test_impossible_networks_are_reported(saved: Path, network: Mapping[str, Any]) -> None:
    card = read_policy_card(saved)
    card_file(saved).write_text(json.dumps({**card, "network": {**card["network"], **network}}))
    assert "policy.json: unusable network" in refused(saved)


@pytest.mark.parametrize("entry", ["settings", "trait_size", "critic_sees_true_traits", "max_vehicles", "actions"])
def test_networks_with_a_part_missing_are_reported(saved: Path, entry: str) -> None:
    card = read_policy_card(saved)
    del card["network"][entry]
    card_file(saved).write_text(json.dumps(card))
    assert "policy.json: unusable network" in refused(saved)


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("place", [weights_file, card_file])
def test_no_file_of_a_policy_can_run_code(saved: Path, tmp_path: Path, kind: str, place: Any) -> None:
    marker = tmp_path / "marker"
    place(saved).write_bytes(bomb(kind, marker))
    assert f"{place(saved).name} is damaged" in refused(saved)
    assert not marker.exists()


def test_the_bombs_are_live(tmp_path: Path) -> None:
    pickle.loads(bomb("pickle", tmp_path / "pickle"))
    np.load(_written(tmp_path / "numpy.npy", bomb("numpy", tmp_path / "numpy")), allow_pickle=True)
    for kind in ("torch", "old torch"):
        torch.load(_written(tmp_path / "file.pt", bomb(kind, tmp_path / kind)), weights_only=False)
    assert all((tmp_path / kind).is_dir() for kind in ("pickle", "numpy", "torch", "old torch"))


def _written(file: Path, content: bytes) -> Path:
    file.write_bytes(content)
    return file
