import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork
from tint_sumo import traits
from tint_sumo.config import LATENT_SIZE, PpoSettings, TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.methods.registry import (
    METHODS,
    Learned,
    Look,
    Rule,
    always_go,
    built_in_methods,
    find_learned,
    find_method,
    learned_methods,
    look_of,
    look_of_encoder,
    needed_encoders,
    no_traits,
    register,
)
from tint_sumo.methods.rules import TimeToCollision
from tint_sumo.policy import ClassifierTraits, EncoderTraits, NeighbourTraits, NoTraits, OracleTraits, StreamingTraits
from tint_sumo.scenes import find_scene, paper_scene
from tint_sumo.traits import TraitModel

LEARNED = learned_methods()
PPO = PpoSettings()
SMALL = TraitSettings(embedding_sizes=(), hidden_size=4, encoder_output_size=4, decoder_output_size=4)


def some_encoder(method: Learned) -> TraitModel | None:
    """A trait model as the method needs it, which nobody trained."""
    return None if method.encoder is None else traits.TRAIT_METHODS[method.encoder](SMALL)


def test_rules_come_first_and_the_oracle_last() -> None:
    assert list(METHODS)[:4] == ["always_go", "ttc", "sumo", "no_labels"]
    assert list(METHODS)[-1] == "oracle"
    assert set(METHODS) - set(LEARNED) == {"always_go", "ttc", "sumo"}
    assert set(METHODS) - set(built_in_methods()) == {"sumo", "relative"}


def test_names_and_titles_belong_to_one_method_each() -> None:
    assert [method.name for method in METHODS.values()] == list(METHODS)
    assert len({method.title for method in METHODS.values()}) == len(METHODS)


@pytest.mark.parametrize("name", LEARNED)
def test_encoders_are_trait_methods_and_shared_trainings_are_methods_that_are_trained(name: str) -> None:
    method = find_learned(name)
    assert method.encoder in (None, *traits.TRAIT_METHODS)
    if method.trained_as is not None:
        other = find_learned(method.trained_as)
        assert other.trained_as is None
        assert other.attention == method.attention
        assert other.make_source(some_encoder(other), PPO).size == method.make_source(some_encoder(method), PPO).size


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("no_labels", NoTraits),
        ("morton", EncoderTraits),
        ("vae", EncoderTraits),
        ("no_attention", EncoderTraits),
        ("cross_window", EncoderTraits),
        ("streaming", StreamingTraits),
        ("streaming_critic", StreamingTraits),
        ("relative", NeighbourTraits),
        ("ma", ClassifierTraits),
        ("oracle", OracleTraits),
    ],
)
def test_each_method_gets_its_traits_from_its_own_source(name: str, kind: type) -> None:
    method = find_learned(name)
    encoder = some_encoder(method)
    source, another = method.make_source(encoder, PPO), method.make_source(encoder, PPO)
    assert type(source) is kind
    assert source is not another
    assert source.size == (5 if kind is StreamingTraits else LATENT_SIZE)


def test_ablations_differ_from_their_methods_in_one_thing() -> None:
    assert not find_learned("no_attention").attention
    assert [name for name in LEARNED if not find_learned(name).attention] == ["no_attention"]
    assert [name for name in LEARNED if find_learned(name).critic_sees_true_traits] == ["streaming_critic"]


def test_rules_act() -> None:
    observation = {"ego": np.zeros((3, 4)), "vehicles": np.zeros((3, 12, 2)), "mask": np.zeros((3, 12))}
    for method in METHODS.values():
        if isinstance(method, Rule):
            actions, _ = method.make(paper_scene()).predict(observation)
            assert actions.shape == (3,)


@pytest.mark.parametrize(("scene", "wanted_s"), [("t_intersection", 1.2), ("t_intersection_street", 4.0)])
def test_the_gap_that_ttc_waits_for_is_that_of_the_scene(scene: str, wanted_s: float) -> None:
    ttc = find_method("ttc")
    assert isinstance(ttc, Rule)
    shorter = replace(find_scene(scene), base=scene, name="shorter", time_limit_s=20.0)
    for played in (find_scene(scene), shorter):
        policy = ttc.make(played)
        assert isinstance(policy, TimeToCollision) and policy.threshold_s == wanted_s


def test_sumo_s_driver_is_a_rule_that_gives_the_ego_to_sumo(user_network: Callable[[str], UserNetwork]) -> None:
    rule, scene = find_method("sumo"), user_network("merge").scene()
    assert isinstance(rule, Rule)
    assert rule.scene_for(scene) == replace(scene, ego_control="sumo")
    with pytest.raises(InputError, match=r"method sumo drives in SUMO configurations alone; give a .sumocfg"):
        rule.scene_for(paper_scene())
    other = find_method("ttc")
    assert isinstance(other, Rule) and other.scene_for(scene) is scene


# Linear RGB as people see it without red cones, and without green ones (Machado, Oliveira and Fernandes 2009).
SIGHTS = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
    ),
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear_rgb(colours: list[str]) -> np.ndarray:
    rgb = np.array([[int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)] for colour in colours])
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def cie_lab(linear: np.ndarray) -> np.ndarray:
    x, y, z = np.cbrt(np.clip(linear @ XYZ.T / XYZ.sum(axis=1), 1e-4, None)).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


@pytest.mark.parametrize(("sight", "least"), [("full", 28), ("protanopia", 14), ("deuteranopia", 14)])
def test_colours_of_methods_are_far_apart_with_and_without_all_cones(sight: str, least: float) -> None:
    seen = cie_lab(np.clip(linear_rgb([method.look.colour for method in METHODS.values()]) @ SIGHTS[sight].T, 0, 1))
    apart = np.linalg.norm(seen[:, None] - seen, axis=2)[np.triu_indices(len(METHODS), 1)]
    assert apart.min() > least  # what people barely notice is 2.3


def test_methods_can_be_told_apart_without_colours_and_seen_on_white_and_on_black() -> None:
    looks = [method.look for method in METHODS.values()]
    assert len({look.marker for look in looks}) == len({look.colour for look in looks}) == len(METHODS)
    luminance = linear_rgb([look.colour for look in looks]) @ XYZ[1]
    assert (1.05 / (luminance + 0.05) > 3).all()  # WCAG's least contrast of graphics, on white
    assert ((luminance + 0.05) / (linear_rgb(["#16181b"]) @ XYZ[1] + 0.05) > 3).all()  # and on the report's dark paper


def test_trait_methods_look_like_the_policies_that_use_them() -> None:
    for name, method in (("vae", "vae"), ("cross_window", "cross_window"), ("morton", "morton"), ("classifier", "ma")):
        assert look_of_encoder(name) == METHODS[method].look
    assert look_of_encoder("unknown") == look_of("unknown") == Look()


@pytest.mark.parametrize("twin", [Rule("ttc", "another", always_go), Learned("ttc", "another", no_traits)])
def test_a_name_is_taken_once(twin: Rule | Learned) -> None:
    with pytest.raises(ValueError, match="two methods are called 'ttc'"):
        register(twin)
    assert METHODS["ttc"].title == "time to collision"


def test_a_new_method_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tint_sumo.methods.registry.METHODS", dict(METHODS))
    new = register(Learned("guess", "a guess", no_traits))
    assert find_method("guess") is find_learned("guess") is new
    assert "guess" not in METHODS


def test_unknown_methods_are_answered_with_the_known_ones() -> None:
    with pytest.raises(
        InputError, match="unknown method 'magic'; choose one of: always_go, ttc, sumo, no_labels, morton"
    ):
        find_method("magic")


def test_rules_are_not_trained() -> None:
    with pytest.raises(InputError, match=r"hand-written rule and needs no training; choose one of: no_labels, morton"):
        find_learned("ttc")
    assert find_learned("vae").encoder == "vae"


def test_a_new_method_is_one_entry() -> None:
    """Help texts, the study's budgets and the list of shipped policies follow from the registry, in a new process."""
    code = """
from tint_sumo.methods import registry
registry.register(registry.Learned("guess", "a guess", registry.no_traits, encoder="morton"))
import sys
assert not {"torch", "numba", "libsumo", "stable_baselines3"} & set(sys.modules)
from tint_sumo.study.budgets import BUDGETS
assert BUDGETS["full"].methods[-1] == "guess"
from tint_sumo.cli import main
try:
    main(["policy", "train", "--help"])
except SystemExit:
    main(["policy", "train", "--method", "nobody", "--out", "nowhere"])
"""
    wide = {**os.environ, "COLUMNS": "400"}
    done = subprocess.run([sys.executable, "-c", code], env=wide, capture_output=True, text=True, check=False)
    assert "oracle, guess" in " ".join(done.stdout.split()), done.stderr
    assert done.stderr.rstrip().endswith("oracle, guess")


def test_trait_models_that_methods_need_are_named_once() -> None:
    assert needed_encoders() == ("morton", "vae", "cross_window", "classifier")
