"""The picture of the packages on the page about the layout of the code."""

import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_the_picture_of_the_packages_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(ROOT / "scripts"), *sys.path])
    import draw_house  # type: ignore[import-not-found]

    assert draw_house.HOUSE.read_text(encoding="utf-8") == draw_house.draw(draw_house.floors(), draw_house.imports())


def test_every_floor_is_explained() -> None:
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    table = (
        (ROOT / "CONTRIBUTING.md")
        .read_text(encoding="utf-8")
        .partition("[start:floors]")[2]
        .partition("[end:floors]")[0]
    )
    rows = [line for line in table.splitlines() if line.startswith("| ") and "tint_sumo/" in line]
    assert len(rows) == len(contract["layers"])
    for row, layer in zip(rows, contract["layers"], strict=True):
        assert all(f"`tint_sumo/{package}" in row for package in layer.split(" | ")), row
