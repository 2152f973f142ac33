"""Policies by name or path, ready to be evaluated."""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from tint_sumo import traits
from tint_sumo.config import LATENT_SIZE, PERFECT, Mix, PpoSettings, Sensor, Traffic
from tint_sumo.core.determinism import preserved_random_state
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.core.structures import build
from tint_sumo.core.weights import card_file, find_weights, weights_file
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.perceived import perceived_in
from tint_sumo.methods.registry import METHODS, Learned, Policy, Rule, find_learned
from tint_sumo.methods.rules import ACTIONS as RULE_ACTIONS
from tint_sumo.methods.training import POLICY, TRAITS, digest
from tint_sumo.policy import GruPolicy, RecurrentPPO, TraitSource
from tint_sumo.policy.storage import load_policy_network, read_policy_card, require_finite
from tint_sumo.policy.wrappers import OnStep, policy_venv
from tint_sumo.scenes import ALL_SCENES, SCENES, AnyScene, SumocfgScene, find_scene, paper_scene, read_described
from tint_sumo.traits import TraitModel
from tint_sumo.traits.storage import shipped_model


@dataclass(frozen=True)
class Contender:
    """A policy and the environment it drives in."""

    name: str
    policy: Policy
    scene: AnyScene  # what it drives in
    source: Callable[[], TraitSource] | None = None  # source of the traits in its observations; None: it has no traits
    p_conservative: Mix | None = Traffic.p_conservative  # what it was trained for; None in a SUMO configuration
    sensor: Sensor = PERFECT  # what it was trained with
    action_repeat: int = 1  # simulation steps per decision
    method: str = ""  # name of the method in the registry

    @property
    def task(self) -> TaskSettings:
        """Settings of the environments that it is for; ``dataclasses.replace`` makes others of them.

        Each case of a SUMO configuration has a warm-up of its own, so that no traffic is that of the training.
        """
        scene = replace(self.scene, warm_starts=0) if isinstance(self.scene, SumocfgScene) else self.scene
        return TaskSettings(scene, self.p_conservative, sensor=self.sensor)

    def make_venv(self, num_envs: int, task: TaskSettings, *, on_step: OnStep | None = None) -> VecEnv:
        """Return environments with the observations that the policy takes.

        In a SUMO configuration each has a process for itself, and there are no more than the machine has cores.
        ``on_step`` is as in ``tint_sumo.policy.wrappers.policy_venv``.
        """
        source = None if self.source is None else self.source()
        count = min(num_envs, os.cpu_count() or 1) if task.scene.sumocfg else num_envs
        return policy_venv(count, source, [task], action_repeat=self.action_repeat, on_step=on_step)


def load_policy(
    name_or_path: str | Path, *, scene: str | AnyScene | None = None, allow_pickle: bool = False
) -> Contender:
    """Return a hand-written rule or a shipped policy by its name, or a trained one by its folder or file.

    The card, a .json file beside the weights, names the method and the trait model.

    Args:
        name_or_path: name, folder of a training run, .safetensors file, or Stable-Baselines3's .zip file with the
            card beside it. The name of a rule comes first, then files that are there, then shipped policies.
        scene: the scene it shall drive in; if not given the one it was trained in, for rules the paper's.
        allow_pickle: read .zip files. They can run any code, so allow that only for files you trust.

    Raises:
        InputError: there is no such policy, or its files are missing, damaged or not to be read.
        NotFiniteError: its outputs are not finite.
    """
    given = None if scene is None else find_scene(scene)
    method = METHODS.get(str(name_or_path))
    if isinstance(method, Rule):
        chosen = method.scene_for(given or paper_scene())
        return _in_scene(Contender(method.name, method.make(chosen), chosen, method=method.name), chosen)
    if Path(name_or_path).suffix == ".zip":
        stem = Path(name_or_path).with_suffix("")
        found = _contender(stem, _load_zip(Path(name_or_path), allow_pickle))
    else:
        stem = find_policy(name_or_path)
        found = _contender(stem, load_policy_network(stem))
    found = replace(found, name=str(name_or_path))
    if given is not None:
        return _in_scene(found, given)
    if len(read_described(read_policy_card(stem))) > 1:
        raise InputError(f"{name_or_path} was trained in all scenes; give the `scene`")
    _require_same_roads(stem, found)
    return found


def _in_scene(contender: Contender, scene: AnyScene) -> Contender:
    """Return the policy for another scene.

    Raises:
        InputError: the scene has other numbers of observed vehicles or of actions, or other keys in its observations.
    """
    network: Any = contender.policy
    is_rule, speeds = contender.source is None, len(scene.ego.controller.desired_speeds_mps)
    vehicles = scene.max_vehicles if is_rule else network.observation_space["vehicles"].shape[0]
    perceives = scene.perceives if isinstance(scene, SumocfgScene) else ()
    needed = perceives if is_rule else perceived_in(network.observation_space.spaces)
    of_rules = speeds if isinstance(scene, SumocfgScene) else RULE_ACTIONS
    actions = of_rules if is_rule else network.action_space.n
    for what, wanted, there in (
        ("max_vehicles", vehicles, scene.max_vehicles),
        ("desired_speeds_mps", actions, speeds),
        ("perceives", ", ".join(needed) or "nothing", ", ".join(perceives) or "nothing"),
    ):
        if wanted != there:
            raise InputError(
                f"policy {contender.name} needs {what} of {wanted}, and scene {scene.name} has {there}; "
                "train a policy in that scene"
            )
    trained_for = Traffic.p_conservative if contender.p_conservative is None else contender.p_conservative
    return replace(contender, scene=scene, p_conservative=None if scene.sumocfg else trained_for)


def _require_same_roads(stem: Path, found: Contender) -> None:
    """Raise InputError if a policy was trained in another version of its scene."""
    if read_policy_card(stem).get("scene_digest") != found.scene.digest:
        scene = "its name" if found.scene.name in SCENES else "its definition"
        raise InputError(
            f"{card_file(stem)}: this policy was trained in another version of the scene {found.scene.name}; "
            f"give {scene} as `scene` to use it all the same"
        )


def _load_zip(file: Path, allow_pickle: bool) -> RecurrentPPO:
    if not allow_pickle:
        raise InputError(
            f"{file} is a pickle, which can run any code when it is read; give the .safetensors file beside it, "
            "or `allow_pickle` if you trust the file"
        )
    print(f"reading {file}, a pickle: it can run any code", file=sys.stderr)
    with preserved_random_state():
        return RecurrentPPO.load(file)


def _contender(stem: Path, policy: GruPolicy | RecurrentPPO) -> Contender:
    card = _checked_card(stem)
    require_finite(policy if isinstance(policy, GruPolicy) else policy.policy, weights_file(stem))
    learned = find_learned(card["method"])
    encoder = None if learned.encoder is None else _load_encoder(stem, card)
    observed = _observation_settings(card["settings"])
    return Contender(
        stem.name,
        policy,
        read_described(card)[0],
        lambda: learned.make_source(encoder, observed),
        None if card["p_conservative"] is None else Mix.parse(card["p_conservative"]),
        build(Sensor, card.get("sensor", {}), ("sensor",)),
        int(card["settings"]["action_repeat"]),
        learned.name,
    )


def _load_encoder(stem: Path, card: dict[str, Any]) -> TraitModel:
    """Return the trait model of the policy's training: the file beside it in a run, or a shipped model by its name."""
    encoder = traits.load(trait_model_of(stem, card), latent_size=LATENT_SIZE)
    if digest(encoder) != card.get("traits_sha256"):
        raise InputError(f"{card_file(stem)} belongs to another trait model {card['traits']}; restore that model")
    return encoder


def trait_model_of(stem: Path, card: Mapping[str, Any]) -> Path:
    """Return the path of the trait model that the card of a policy names: the one beside it, or a shipped one."""
    named: str = card["traits"]
    return weights_file(stem.with_name(TRAITS)) if named == TRAITS else shipped_model(named)


def find_policy(name_or_path: str | Path) -> Path:
    """Return the path of a policy without its suffix.

    Raises:
        InputError: there is no such policy.
    """
    folder = _shipped_folder()
    if (stem := find_weights(Path(name_or_path), POLICY, folder)) is not None:
        return stem
    if (Path(name_or_path) / "run.json").exists():
        raise InputError(f"{name_or_path} holds a run that is not finished; repeat its command to finish it")
    rules = [name for name, method in METHODS.items() if isinstance(method, Rule)]
    others = sorted(file.relative_to(folder).with_suffix("").as_posix() for file in folder.glob("*/*.safetensors"))
    raise InputError(
        f"no policy {name_or_path}; give {', '.join([*rules, *shipped_policies(), *others])}, the folder of a training "
        "run or a .safetensors file"
    )


def shipped_policy(name: str) -> Path:
    """Return the path of a shipped policy without its suffix: that policy, whatever the present folder holds."""
    return _shipped_folder() / name


def _shipped_folder() -> Path:
    return shipped("models") / "policies"


def shipped_policies() -> list[str]:
    """Return the names of the shipped policies of the paper's setting, in the order of the methods."""
    return [name for name in METHODS if weights_file(shipped_policy(name)).is_file()]


def _checked_card(stem: Path) -> dict[str, Any]:
    card = read_policy_card(stem)
    method = METHODS.get(str(card.get("method")))
    settings = card.get("settings")
    mix = card.get("p_conservative")
    fits = isinstance(method, Learned) and (_can(Mix.parse, mix) or (mix is None and "scene_settings" in card))
    fits &= isinstance(settings, dict) and isinstance(settings.get("action_repeat"), int)
    fits &= isinstance(settings, dict) and _can(_observation_settings, settings)
    fits &= "traits" in card and all(isinstance(card.get(name), int) for name in ("steps", "seed"))
    fits &= "scene_settings" in card or str(card.get("scene")) in (*SCENES, ALL_SCENES)
    fits &= _can(partial(build, Sensor), card.get("sensor", {}))
    if not fits or (isinstance(method, Learned) and method.encoder and not _is_file_name(card.get("traits"))):
        raise InputError(f"{card_file(stem)} is not the card of a policy; restore the file or train the policy again")
    return card


def _observation_settings(settings: dict[str, Any]) -> PpoSettings:
    """Return settings with those of a card that say what the policy observes; older cards have none of them.

    Raises:
        FieldError: they make no sense.
    """
    found = {name: settings[name] for name in ("motion", "relative") if name in settings}
    observed: PpoSettings = build(PpoSettings, found)
    return observed


def _can(read: Callable[[Any], object], value: object) -> bool:
    """Return whether a value can be read so, without an InputError."""
    try:
        read(value)
    except InputError:
        return False
    return True


def _is_file_name(value: object) -> bool:
    return isinstance(value, str) and value != "" and Path(value).name == value
