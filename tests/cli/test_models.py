"""``tint-sumo models``."""

import pytest

from tests.cli.calls import refuse, run
from tint_sumo import traits
from tint_sumo.cli import main
from tint_sumo.methods.registry import METHODS, Learned, built_in_methods


def test_models_are_listed_and_shown(capsys: pytest.CaptureFixture[str]) -> None:
    models = run(capsys, "models")["models"]
    kinds = {kind: {one["name"] for one in models if one["kind"] == kind} for kind in ("trait model", "policy")}
    learned = {name for name in built_in_methods() if isinstance(METHODS[name], Learned)}
    strangers = {f"strangers/{name}" for name in ("no_labels", "relative", "oracle")}
    assert kinds == {"trait model": set(traits.TRAIT_METHODS), "policy": learned | strangers}
    assert {one["scene"] for one in models} == {"t_intersection"}
    assert all("% of windows" in one["result"] or one["result"].startswith("success ") for one in models)
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["name", "kind", "method", "scene", "training", "result"]
    assert len(lines) == 1 + len(models)
    cards = run(capsys, "models", "vae")["models"]
    assert [(one["kind"], one["card"]["method"]) for one in cards] == [("trait model", "vae"), ("policy", "vae")]
    (card,) = run(capsys, "models", "strangers/relative")["models"]
    assert (card["card"]["method"], len(card["card"]["sensors"])) == ("relative", 9)
    assert "unknown shipped model 'nobody'; choose one of: classifier, " in refuse(capsys, "models", "nobody")
