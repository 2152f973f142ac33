"""Checksums of weights."""

import hashlib
import shutil
from pathlib import Path

import pytest

from tint_sumo.core.files import read_json, shipped
from tint_sumo.core.weights import SHA256, add_checksum

SHIPPED = sorted(shipped("models").rglob("*.safetensors"))


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_cards_of_shipped_models_have_the_checksums_of_their_weights(file: Path) -> None:
    assert read_json(file.with_suffix(".json"), "card")[SHA256] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_card_gets_the_checksum_and_keeps_the_rest(tmp_path: Path) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copyfile(SHIPPED[0].with_suffix(suffix), tmp_path / f"model{suffix}")
    file, card = tmp_path / "model.safetensors", tmp_path / "model.json"
    before = card.read_text()
    add_checksum(file)
    assert card.read_text() == before
    file.write_bytes(b"other")
    add_checksum(file)
    after = read_json(card, "card")
    assert after.pop(SHA256) == hashlib.sha256(b"other").hexdigest()
    assert after.items() <= read_json(SHIPPED[0].with_suffix(".json"), "card").items()
