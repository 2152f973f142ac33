"""Policies and trait models as ONNX files: driven by onnxruntime, they act as the originals do."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.scenes.networks import lights
from tint_sumo.config import ALL_MIXES, EgoController, PpoSettings
from tint_sumo.methods.driving import drive
from tint_sumo.methods.evaluation import case_seed
from tint_sumo.methods.loading import Contender, load_policy
from tint_sumo.methods.training import train_policy
from tint_sumo.policy import GruPolicy
from tint_sumo.policy.trait_sources import Frame, TraitSource

onnxruntime = pytest.importorskip("onnxruntime", reason='needs: pip install "tint_sumo[onnx]"')
onnx_files = pytest.importorskip("tint_sumo.methods.onnx_files", reason='needs: pip install "tint_sumo[onnx]"')

STEPS = 1000
WINDOW = 20


class Session:
    """A file in onnxruntime, and its metadata."""

    def __init__(self, file: Path) -> None:
        self.session = onnxruntime.InferenceSession(file)
        metadata = self.session.get_modelmeta().custom_metadata_map
        in_json = ("inputs", "outputs", "desired_speeds_mps", "decision_interval_s")
        self.metadata = {key: json.loads(text) if key in in_json else text for key, text in metadata.items()}
        self.inputs, self.outputs = self.metadata["inputs"], self.metadata["outputs"]

    def zeros(self, name: str, count: int) -> np.ndarray:
        return np.zeros((count, *self.inputs[name]["shape"][1:]), self.inputs[name]["type"])

    def run(self, **inputs: np.ndarray) -> list[np.ndarray]:
        assert list(inputs) == list(self.inputs)
        found: list[np.ndarray] = self.session.run(None, inputs)
        return found


class OnnxPolicy:
    """Stable-Baselines3's ``predict``, by a file that takes metres."""

    def __init__(self, file: Path, contender: Contender) -> None:
        self.file, self.scene = Session(file), contender.scene

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        ego, scene = observation["ego"], self.scene
        hidden = self.file.zeros("hidden", len(ego)) if state is None else np.where(episode_start[:, None], 0.0, state)
        present = observation["mask"] > 0.5
        inputs = {
            "ego_position_m": ego[:, :2] * np.float32(scene.ego_scale_m),
            "ego_velocity_mps": ego[:, 2:] * np.float32(scene.speed_scale_mps),
            "vehicle_position_m": np.where(
                present[..., None], observation["vehicles"] * np.float32(scene.position_scale_m), np.float32(np.nan)
            ),
            "vehicle_present": present,
        }
        inputs |= {key: observation[key] for key in self.file.inputs if key in observation}
        action, speed_mps, hidden = self.file.run(**inputs, hidden=hidden.astype(np.float32))
        speeds = self.file.metadata["desired_speeds_mps"]
        np.testing.assert_array_equal(speed_mps, np.float32(speeds)[action])
        return action, hidden


class Compared:
    """A policy and its file, which choose for the same observations what the policy thinks best.

    One that has hardly been trained often thinks two speeds as good as equal, and either may be chosen then.
    """

    def __init__(self, contender: Contender, file: Path) -> None:
        assert isinstance(contender.policy, GruPolicy)
        self.policy, self.file, self.decisions = contender.policy, OnnxPolicy(file, contender), 0

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        before, hidden = (None, None) if state is None else state
        actions, after = self.policy.predict(observation, before, episode_start, deterministic)
        found, hidden = self.file.predict(observation, hidden, episode_start)
        tensors, _ = self.policy.obs_to_tensor(observation)
        states = self.policy.initial_states(len(found)) if before is None else torch.from_numpy(before[0])
        latent, _ = self.policy.latent_actor(tensors, states, torch.from_numpy(episode_start))
        logits = self.policy.action_net(latent).numpy()
        assert (logits.max(axis=1) - logits[np.arange(len(found)), found] < 1e-5).all()
        np.testing.assert_allclose(hidden, after[0], atol=1e-5)
        self.decisions += len(found)
        return actions, (after, hidden)


class OnnxTraits(TraitSource):
    """Traits of a file, of windows or of whole tracks, taken as the page ``docs/how-to/robots.md`` says."""

    needs_tracks = True

    def __init__(self, file: Path, *, windows: bool) -> None:
        self.file, self.windows = Session(file), windows
        self.size = self.file.outputs["traits"]["shape"][1]

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        super().attach(num_envs, max_vehicles)
        self.state = self.file.zeros("state", num_envs * max_vehicles).reshape(num_envs, max_vehicles, -1)
        self.steps, self.seen = np.zeros(num_envs, int), np.zeros((num_envs, max_vehicles), int)

    def begin(self, frame: Frame) -> None:
        self.steps[frame.done] = 0
        self.state[frame.done] = self.traits[frame.done] = 0.0
        self.follow(frame, frame.done)

    def advance(self, frame: Frame) -> None:
        self.steps += 1
        if self.windows:
            self.state[self.steps % WINDOW == 1] = self.seen[self.steps % WINDOW == 1] = 0
        self.follow(frame, np.ones(len(frame.done), bool))

    def follow(self, frame: Frame, envs: np.ndarray) -> None:
        self.state[~frame.present] = self.seen[~frame.present] = 0
        self.traits[~frame.present] = 0.0
        self.seen[frame.present] += 1
        now = frame.present & envs[:, None]
        position_m, gap_m = (frame.slots[key][now].astype(np.float32) for key in ("position_m", "gap_m"))
        traits, self.state[now] = self.file.run(position_m=position_m, gap_m=gap_m, state=self.state[now])
        if not self.windows:
            self.traits[now] = traits
            return
        due = (self.steps % WINDOW == 0) & (self.steps > 0)
        counts = due[:, None] & now & (self.seen >= 2) & (frame.slots["passed"] == 0)
        self.traits[counts] = traits[counts[now]]


def driven(contender: Contender, episodes: int, batch: int = 40) -> list[tuple[list[int], str]]:
    found = drive(
        contender.policy, lambda count: contender.make_venv(count, contender.task), case_seed(0), episodes, batch
    )
    by_number = sorted(found, key=lambda one: one.number)
    return [(one.actions, one.info["outcome"]) for one in by_number]


def require_same(contender: Contender, folder: Path, episodes: int = 40, batch: int = 40) -> Contender:
    """Drive a policy, and then its files, and compare all actions of so many episodes; returns the files' driver."""
    onnx_files.write_policy(contender, folder / "policy.onnx")
    files = replace(contender, policy=OnnxPolicy(folder / "policy.onnx", contender))
    steps = onnx_files.steps_of(contender)
    if steps is not None:
        onnx_files.write_traits(steps, contender.name, folder / "traits.onnx")
        windows = "window" in steps.begins
        files = replace(files, source=lambda: OnnxTraits(folder / "traits.onnx", windows=windows))
    expected = driven(contender, episodes, batch)
    assert sum(len(actions) for actions, _ in expected) >= STEPS
    assert driven(files, episodes, batch) == expected
    return files


def compare(contender: Contender, file: Path, episodes: int, batch: int) -> Compared:
    """Drive so many episodes with a policy, and ask its file at each decision, too."""
    onnx_files.write_policy(contender, file)
    compared = Compared(contender, file)
    driven(replace(contender, policy=compared), episodes, batch)
    assert compared.decisions >= STEPS
    return compared


@pytest.mark.slow
def test_files_act_as_policy_and_trait_model_do_and_say_what_they_take(tmp_path: Path) -> None:
    contender = load_policy("streaming")
    files = require_same(contender, tmp_path)
    assert {action for actions, _ in driven(contender, 5) for action in actions} == {0, 1, 2}
    assert isinstance(files.policy, OnnxPolicy)
    metadata = files.policy.file.metadata
    assert metadata["desired_speeds_mps"] == [0.0, 0.5, 3.0]
    assert (metadata["decision_interval_s"], metadata["method"], metadata["scene"]) == (
        0.4,
        "streaming",
        "t_intersection",
    )
    assert metadata["inputs"]["vehicle_position_m"]["high"] == 40.0
    for file in ("policy.onnx", "traits.onnx"):
        session = Session(tmp_path / file)
        for described, found in (
            (session.inputs, session.session.get_inputs()),
            (session.outputs, session.session.get_outputs()),
        ):
            assert [(one.name, one.shape) for one in found] == [
                (name, known["shape"]) for name, known in described.items()
            ]
    assert (tmp_path / "policy.onnx").stat().st_size < 500_000


@pytest.mark.long
@pytest.mark.parametrize("name", ["vae", "no_attention", "no_labels", "ma", "morton", "cross_window", "oracle"])
def test_files_of_all_shipped_kinds_act_as_the_policies_do(name: str, tmp_path: Path) -> None:
    require_same(load_policy(name), tmp_path)


OF_TRAITS = {"streaming": "means of the latents", "no_labels": "0, always", "relative": "belief that the driver yields"}


@pytest.mark.long
@pytest.mark.parametrize("method", OF_TRAITS)
def test_files_of_policies_that_see_motion_act_as_these_do(method: str, tmp_path: Path, tiny: PpoSettings) -> None:
    settings = replace(tiny, motion=True)
    train_policy(method, ALL_MIXES, 64, 0, tmp_path / "run", settings=settings)
    compared = compare(load_policy(tmp_path / "run"), tmp_path / "policy.onnx", episodes=10, batch=10)
    meaning = compared.file.file.inputs["traits"]["meaning"]
    assert meaning.startswith("of each vehicle: speed / 3 m/s") and OF_TRAITS[method] in meaning.split("; then ")[1]


@pytest.mark.long
def test_files_of_policies_for_sumo_configurations_act_as_these_do(tmp_path: Path, tiny: PpoSettings) -> None:
    perceives = ("traffic_light", "right_of_way", "speed_limit", "lane", "pedestrians")
    controller = EgoController((0.0, 4.0, 8.0, 11.0))
    scene = lights(tmp_path, 0.5).scene(controller=controller, warm_up_s=5.0, time_limit_s=60.0, perceives=perceives)
    train_policy("no_labels", None, 64, 0, tmp_path / "run", settings=tiny, scene=scene)
    compare(load_policy(tmp_path / "run"), tmp_path / "policy.onnx", episodes=14, batch=1)
