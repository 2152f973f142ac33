"""Policies and trait models as ONNX files, which run without Python: in C++, on a robot.

A file holds one step of one network, which takes metres and metres per second. Whatever must be kept from step to step
goes in and out as a tensor. Its metadata say the rest, see ``docs/how-to/robots.md``.
"""

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import onnx
import onnxscript  # noqa: F401 - torch asks for it only when it exports
import torch
from gymnasium import spaces
from torch import Tensor, nn

from tint_sumo import __version__
from tint_sumo.config import OBSERVATION_BOUND, STEP_S, WINDOW_STEPS
from tint_sumo.core.files import write_bytes
from tint_sumo.methods.loading import Contender
from tint_sumo.policy import GruPolicy, NoTraits, StreamingTraits
from tint_sumo.policy.attention import AllSlots
from tint_sumo.policy.network import AttentionExtractor
from tint_sumo.policy.trait_sources import WithMotion
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS
from tint_sumo.scenes import AnyScene
from tint_sumo.traits import TraitModel
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.stepping import TrackSteps, TraitSteps, WindowSteps

_MOTION_MEANING = (
    "speed / 3 m/s as a moving average over about 0.3 s, how much that exceeds the average over about 1.2 s in m/s, "
    "gap to the leader / 10 m and at most 2; then "
)
_MEASURED = {"ego", "vehicles", "mask", TRAITS, TRUE_TRAITS}  # keys of observations with inputs of other names
_EXAMPLES = 2  # vehicles or environments in the example that the exporter follows


@dataclass(frozen=True)
class Tensors:
    """An input or output of a file."""

    shape: tuple[int | str, ...]  # "batch": any number of independent egos or vehicles
    type: str
    unit: str
    meaning: str
    low: float | None = None  # of its range; what lies outside is clipped, None: no limit
    high: float | None = None


class _Flat(nn.Module):
    """A network whose arguments are all behind one ``*``, as their shapes are given to the exporter."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        outputs: tuple[Tensor, ...] = self.network(*inputs)
        return outputs


class PolicySteps(nn.Module):
    """One decision of a policy for B egos, from metres and metres per second.

    Args:
        policy: the network.
        scene: it drives in.
        has_traits: whether traits are an input; else they are zeros.
    """

    speeds_mps: Tensor

    def __init__(self, policy: GruPolicy, scene: AnyScene, *, has_traits: bool) -> None:
        super().__init__()
        self.policy = deepcopy(policy).cpu()
        self.policy.set_training_mode(False)
        extractor = self.policy.features_extractor
        assert isinstance(extractor, AttentionExtractor)
        extractor.packing = AllSlots
        assert isinstance(policy.observation_space, spaces.Dict)
        self.space = policy.observation_space
        self.has_traits = has_traits
        self.road = tuple(key for key in self.space.spaces if key not in _MEASURED)
        self.position_scale_m, self.ego_scale_m = scene.position_scale_m, scene.ego_scale_m
        self.speed_scale_mps = scene.speed_scale_mps
        speeds = torch.tensor(scene.ego.controller.desired_speeds_mps, dtype=torch.float32)
        self.register_buffer("speeds_mps", speeds)

    def inputs(self) -> dict[str, Tensors]:
        """Return what ``forward`` takes, in its order."""
        limits_m, limit_mps = (OBSERVATION_BOUND * scale for scale in (self.position_scale_m, self.speed_scale_mps))
        ego_m = OBSERVATION_BOUND * self.ego_scale_m
        slots, size = self._shape(TRAITS)
        found = {
            "ego_position_m": Tensors(("batch", 2), "float32", "m", "x, y of the ego's centre", -ego_m, ego_m),
            "ego_velocity_mps": Tensors(
                ("batch", 2), "float32", "m/s", "x, y velocity of the ego", -limit_mps, limit_mps
            ),
            "vehicle_position_m": Tensors(
                ("batch", slots, 2),
                "float32",
                "m",
                "x, y of each vehicle's centre minus the ego's; anything in empty slots",
                -limits_m,
                limits_m,
            ),
            "vehicle_present": Tensors(("batch", slots), "bool", "", "whether the slot holds a vehicle"),
        }
        if self.has_traits:
            found["traits"] = Tensors(("batch", slots, size), "float32", "", "")
        for key in self.road:
            meaning = f"{key} of the environment's observation, scaled as there"
            found[key] = Tensors(("batch", *self._shape(key)), "float32", "", meaning)
        hidden = self.policy.settings.hidden_size
        return {**found, "hidden": Tensors(("batch", hidden), "float32", "", "zeros at the start of an episode")}

    def outputs(self) -> dict[str, Tensors]:
        """Return what ``forward`` returns, in its order."""
        hidden = self.policy.settings.hidden_size
        return {
            "action": Tensors(("batch",), "int64", "", "number of the desired speed", 0, len(self.speeds_mps) - 1),
            "desired_speed_mps": Tensors(("batch",), "float32", "m/s", "speed along the ego's way"),
            "new_hidden": Tensors(("batch", hidden), "float32", "", "hidden of the next decision"),
        }

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (B,), desired speeds (B,) in m/s and the next hidden states (B, H)."""
        given = dict(zip(self.inputs(), inputs, strict=True))
        ego_m, ego_mps = given["ego_position_m"], given["ego_velocity_mps"]
        ego = torch.cat([ego_m / self.ego_scale_m, ego_mps / self.speed_scale_mps], dim=-1)
        vehicles = given["vehicle_position_m"] / self.position_scale_m
        observation = {
            "ego": ego.clamp(-OBSERVATION_BOUND, OBSERVATION_BOUND),
            "vehicles": vehicles.clamp(-OBSERVATION_BOUND, OBSERVATION_BOUND),
            "mask": given["vehicle_present"].to(ego.dtype),
            TRAITS: given[TRAITS] if self.has_traits else ego.new_zeros(ego.shape[0], *self._shape(TRAITS)),
            **{key: given[key] for key in self.road},
        }
        latent, after = self.policy.latent_actor(observation, given["hidden"], torch.zeros_like(ego[:, 0]))
        action = self.policy.action_net(latent).argmax(dim=-1)
        return action, self.speeds_mps[action], after

    def _shape(self, key: str) -> tuple[int, ...]:
        shape = self.space[key].shape
        assert shape is not None
        return shape


def write_policy(contender: Contender, file: Path) -> None:
    """Write the network of a learned policy as ``file``.

    Its metadata are name, method, scene, desired_speeds_mps, decision_interval_s, inputs and outputs, in JSON.
    """
    assert contender.source is not None
    policy = contender.policy if isinstance(contender.policy, GruPolicy) else contender.policy.policy  # type: ignore[attr-defined]
    source = contender.source()
    network = PolicySteps(policy, contender.scene, has_traits=not isinstance(source, NoTraits))
    inner = source.inner if isinstance(source, WithMotion) else source
    encoder = steps_of(contender)
    meaning = inner.meaning if encoder is None else encoder.meaning
    motion = _MOTION_MEANING if inner is not source else ""
    inputs = network.inputs()
    if TRAITS in inputs:
        inputs[TRAITS] = replace(inputs[TRAITS], meaning=f"of each vehicle: {motion}{meaning}")
    speeds = list(contender.scene.ego.controller.desired_speeds_mps)
    details = {
        "name": contender.name,
        "method": contender.method,
        "scene": contender.scene.name,
        "desired_speeds_mps": speeds,
        "decision_interval_s": round(contender.action_repeat * contender.scene.step_s, 9),
    }
    _write(network, file, inputs, network.outputs(), details)


def steps_of(contender: Contender) -> TraitSteps | None:
    """Return the trait model of a policy in the form in which the policy uses it; None if it needs none."""
    source = contender.source() if contender.source is not None else None
    inner = source.inner if isinstance(source, WithMotion) else source
    model = getattr(inner, "model", None)
    if not isinstance(model, TraitModel):
        return None
    return trait_steps(model, streaming=isinstance(inner, StreamingTraits))


def trait_steps(model: TraitModel, *, streaming: bool) -> TraitSteps:
    """Return one step of a trait model: of a whole track if ``streaming``, else of a window."""
    if streaming:
        assert isinstance(model, CrossWindow)
        return TrackSteps(model)
    return WindowSteps(model)


def write_traits(steps: TraitSteps, name: str, file: Path) -> None:
    """Write one step of a trait model as ``file``; its metadata are name, method, interval_s, inputs and outputs."""
    size = len(steps(*_examples(_trait_inputs(steps)).values())[0][0])
    outputs = {
        "traits": Tensors(("batch", size), "float32", "", steps.meaning),
        "new_state": Tensors(("batch", steps.state_size), "float32", "", "state of the next step"),
    }
    details = {"name": name, "method": steps.model.method, "interval_s": STEP_S, "window_steps": WINDOW_STEPS}
    _write(steps, file, _trait_inputs(steps), outputs, details)


def _trait_inputs(steps: TraitSteps) -> dict[str, Tensors]:
    limit_m = steps.model.no_leader_gap_m
    return {
        "position_m": Tensors(("batch",), "float32", "m", "position of each vehicle's front along its lane"),
        "gap_m": Tensors(("batch",), "float32", "m", "gap to its leader, infinite without one", 0.0, limit_m),
        "state": Tensors(("batch", steps.state_size), "float32", "", steps.begins),
    }


def _examples(inputs: Mapping[str, Tensors]) -> dict[str, Tensor]:
    """Return inputs of the shapes that are described."""
    return {
        name: torch.zeros(
            [_EXAMPLES if size == "batch" else int(size) for size in known.shape], dtype=getattr(torch, known.type)
        )
        for name, known in inputs.items()
    }


@torch.no_grad()
def _write(
    network: nn.Module,
    file: Path,
    inputs: Mapping[str, Tensors],
    outputs: Mapping[str, Tensors],
    details: Mapping[str, object],
) -> None:
    examples = _examples(inputs)
    batch = {0: torch.export.Dim("batch", min=1, max=2**16)}
    with _quiet():
        program = torch.onnx.export(
            _Flat(network).eval(),
            tuple(examples.values()),
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_shapes=((batch,) * len(inputs),),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    tensors = {
        kind: {name: asdict(known) for name, known in named.items()}
        for kind, named in (("inputs", inputs), ("outputs", outputs))
    }
    metadata = {"tint_sumo": __version__, **details, **tensors}
    onnx.helper.set_model_props(
        model, {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    )
    onnx.checker.check_model(model)
    write_bytes(file, model.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep to itself, in the block, what torch says about packages that it does not find and its own old code."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
