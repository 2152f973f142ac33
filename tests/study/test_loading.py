import json
from pathlib import Path
from typing import Any

import pytest

from tint_sumo.config import PpoSettings
from tint_sumo.errors import InputError
from tint_sumo.study.loading import load_policy
from tint_sumo.study.rules import AlwaysGo, TimeToCollision
from tint_sumo.study.training import train_policy


@pytest.fixture
def trained(tmp_path: Path, tiny: PpoSettings) -> Path:
    return train_policy("no_labels", 0.6, 64, 0, tmp_path / "run", settings=tiny)


def test_rules_by_name() -> None:
    assert isinstance(load_policy("always_go").policy, AlwaysGo)
    assert isinstance(load_policy("ttc").policy, TimeToCollision)
    assert load_policy("ttc").source is None


def test_a_folder_that_is_called_like_a_rule_is_still_reached_by_path(trained: Path) -> None:
    named = trained.parent.rename(trained.parent.with_name("ttc"))
    assert load_policy(named).p_conservative == 0.6


def test_unknown_names(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no policy nobody; give shipped, always_go, ttc, the folder"):
        load_policy("nobody")
    with pytest.raises(InputError, match="no policy"):
        load_policy(tmp_path)


def test_a_damaged_policy(trained: Path) -> None:
    trained.write_bytes(trained.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"policy\.zip"):
        load_policy(trained)


def test_a_missing_card(trained: Path) -> None:
    trained.with_suffix(".json").unlink()
    with pytest.raises(InputError, match="card of the policy: no file"):
        load_policy(trained)


def change_card(policy: Path, **changes: Any) -> None:
    card_file = policy.with_suffix(".json")
    card_file.write_text(json.dumps({**json.loads(card_file.read_text()), **changes}))


@pytest.mark.parametrize("changes", [{"method": "ttc"}, {"method": "vae"}, {"p_conservative": None}, {"settings": {}}])
def test_a_wrong_card(trained: Path, changes: dict[str, Any]) -> None:
    change_card(trained, **changes)
    with pytest.raises(InputError, match=r"policy\.json is not the card of a policy"):
        load_policy(trained)


def test_a_damaged_card(trained: Path) -> None:
    trained.with_suffix(".json").write_text("{")
    with pytest.raises(InputError, match=r"policy\.json is damaged"):
        load_policy(trained)


def test_a_missing_trait_model(trained: Path) -> None:
    change_card(trained, method="vae", traits="traits")
    with pytest.raises(InputError, match="no trait model"):
        load_policy(trained)
