from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from torch import Tensor

from tint_sumo.config import PolicySettings
from tint_sumo.core.errors import InputError
from tint_sumo.envs.perceived import perceived_spaces
from tint_sumo.policy.network import AttentionExtractor, GruPolicy, QuickTanh
from tint_sumo.policy.wrappers import TRUE_TRAITS

from .tasks import SMALL, STREET, STREET_WITH_TRAITS, box


def scene(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Random streets; the first has no vehicle, the last has 12."""
    random = torch.Generator().manual_seed(seed)
    mask = (torch.rand(count, 12, generator=random) < 0.6).float()
    mask[0], mask[-1] = 0.0, 1.0
    return {
        "ego": torch.randn(count, 4, generator=random),
        "vehicles": torch.randn(count, 12, 2, generator=random),
        "traits": torch.randn(count, 12, 2, generator=random),
        "mask": mask,
    }


@pytest.fixture
def extractor() -> AttentionExtractor:
    torch.manual_seed(0)
    return AttentionExtractor(STREET_WITH_TRAITS)


def make(space: spaces.Space[Any], actions: spaces.Space[Any] | None = None, **kwargs: Any) -> GruPolicy:
    torch.manual_seed(0)
    return GruPolicy(space, actions or spaces.Discrete(3), lambda _: 1e-3, **{"settings": SMALL, **kwargs})


def test_sizes_are_the_papers(extractor: AttentionExtractor) -> None:
    linear = {n: tuple(m.weight.shape)[::-1] for n, m in extractor.named_modules() if isinstance(m, torch.nn.Linear)}
    assert list(linear.values()) == [
        (8, 150), (150, 100),  # embedding
        (200, 100), (100, 100), (100, 1),  # score
        (100, 50),  # context
        (54, 150), (150, 100), (100, 64),  # joint
    ]  # fmt: skip
    policy = make(STREET_WITH_TRAITS, settings=PolicySettings())
    assert policy.gru.weight_hh.shape == (3 * 256, 256)
    assert [m.out_features for m in policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)] == [256, 256]


def test_content_of_empty_slots_has_no_influence(extractor: AttentionExtractor) -> None:
    observations = scene(16)
    other = scene(16, seed=1)
    empty = (observations["mask"] == 0.0).unsqueeze(-1)
    filled = {
        **observations,
        "vehicles": torch.where(empty, other["vehicles"], observations["vehicles"]),
        "traits": torch.where(empty, torch.full_like(other["traits"], torch.nan), observations["traits"]),
    }
    assert torch.equal(extractor(filled), extractor(observations))
    assert torch.equal(extractor.attention(filled), extractor.attention(observations))


def test_real_vehicles_have_influence(extractor: AttentionExtractor) -> None:
    observations = scene(16)
    features = extractor(observations)
    for key in ("vehicles", "traits", "mask"):
        changed = extractor({**observations, key: scene(16, seed=1)[key]})
        assert (changed[1:-1] != features[1:-1]).any(dim=-1).all()


def test_order_of_slots_has_no_influence(extractor: AttentionExtractor) -> None:
    observations = scene(16)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = {key: value if key == "ego" else value[:, order] for key, value in observations.items()}
    torch.testing.assert_close(extractor(shuffled), extractor(observations))
    torch.testing.assert_close(extractor.attention(shuffled), extractor.attention(observations)[:, order])


def test_equals_the_formula_vehicle_by_vehicle(extractor: AttentionExtractor) -> None:
    """The paper's equations, on the real vehicles of each street alone."""
    observations = scene(8)
    features, attention = extractor(observations), extractor.attention(observations)
    for row in range(1, 8):
        street = {key: value[row] for key, value in observations.items()}
        real = street["mask"] > 0.5
        ego = street["ego"].expand(int(real.sum()), 4)
        e = extractor.embed(torch.cat([street["vehicles"][real], street["traits"][real], ego], dim=1))
        alpha = torch.softmax(extractor.score(torch.cat([e, e.mean(0).expand_as(e)], dim=1)), dim=0)
        context = extractor.context((alpha * e).sum(0))
        torch.testing.assert_close(attention[row, real], alpha[:, 0])
        torch.testing.assert_close(features[row], extractor.joint(torch.cat([context, street["ego"]])))


def test_street_without_vehicles(extractor: AttentionExtractor) -> None:
    observations = {**scene(3), "mask": torch.zeros(3, 12)}
    features = extractor(observations)
    features.sum().backward()
    assert torch.isfinite(features).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in extractor.parameters())
    assert torch.equal(extractor.attention(observations), torch.zeros(3, 12))


def test_what_is_observed_of_the_road_has_influence_and_is_the_last_input() -> None:
    torch.manual_seed(0)
    without = AttentionExtractor(STREET_WITH_TRAITS)
    torch.manual_seed(0)
    road = perceived_spaces(("traffic_light", "lane"), 12)
    extractor = AttentionExtractor(spaces.Dict({**STREET_WITH_TRAITS.spaces, **road}))
    assert [one.shape for one in without.embed.parameters()] == [one.shape for one in extractor.embed.parameters()]
    assert extractor.joint[0].in_features == without.joint[0].in_features + 8 + 2  # type: ignore[operator, union-attr]
    light, lane = torch.zeros(4, 8), torch.ones(4, 2)
    observations = {**scene(4), "traffic_light": light, "lane": lane}
    red = light.clone()
    red[:, 0] = 1.0
    features = extractor(observations)
    assert not torch.equal(extractor({**observations, "traffic_light": red}), features)
    assert not torch.equal(extractor({**observations, "lane": 2 * lane}), features)


def test_priorities_belong_to_vehicles_and_pedestrians_have_no_order() -> None:
    torch.manual_seed(0)
    road = perceived_spaces(("right_of_way", "pedestrians"), 12)
    extractor = AttentionExtractor(spaces.Dict({**STREET_WITH_TRAITS.spaces, **road}))
    random = torch.Generator().manual_seed(1)
    observations = {
        **scene(6),
        "right_of_way": torch.rand(6, 2, generator=random),
        "priority": (torch.rand(6, 12, generator=random) < 0.5).float(),
        "pedestrians": torch.randn(6, 8, 4, generator=random),
        "pedestrian_mask": (torch.arange(8) < torch.tensor([[0], [1], [3], [5], [8], [8]])).float(),
    }
    features = extractor(observations)
    order = torch.randperm(12, generator=random)
    turned = {key: observations[key][:, order] for key in ("vehicles", "mask", "traits", "priority")}
    torch.testing.assert_close(extractor({**observations, **turned}), features)
    turned = {key: observations[key].flip(1) for key in ("pedestrians", "pedestrian_mask")}
    torch.testing.assert_close(extractor({**observations, **turned}), features)
    nobody = (1.0 - observations["pedestrian_mask"]).unsqueeze(-1)
    ghosts = {"pedestrians": observations["pedestrians"] + 9.0 * nobody}
    torch.testing.assert_close(extractor({**observations, **ghosts}), features)
    for key in ("priority", "pedestrians", "right_of_way"):
        changed = extractor({**observations, key: observations[key] + 1.0})
        assert not torch.equal(changed[-1], features[-1]), key


def test_attention_sums_to_one(extractor: AttentionExtractor) -> None:
    observations = scene(16)
    weights = extractor.attention(observations)
    assert (weights[observations["mask"] == 0.0] == 0.0).all()
    torch.testing.assert_close(weights[1:].sum(1), torch.ones(15))


def test_observations_without_traits_are_refused() -> None:
    with pytest.raises(InputError, match="traits"):
        AttentionExtractor(STREET)


def test_extractor_follows_the_space() -> None:
    assert isinstance(make(STREET_WITH_TRAITS).features_extractor, AttentionExtractor)
    assert isinstance(make(STREET).features_extractor, CombinedExtractor)
    assert isinstance(make(box(2, 3)).features_extractor, FlattenExtractor)


@pytest.mark.parametrize("space", [STREET_WITH_TRAITS, STREET, box(3), spaces.Discrete(5)])
@pytest.mark.parametrize("actions", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), box(2)])
def test_sequence_equals_acting_step_by_step(space: spaces.Space[Any], actions: spaces.Space[Any]) -> None:
    policy, count, steps = make(space, actions), 3, 6
    space.seed(0)
    torch.manual_seed(1)
    starts = torch.zeros(steps, count)
    starts[2, 0] = starts[4, 1] = starts[4, 2] = 1.0
    before = states = torch.randn(count, SMALL.hidden_size)
    seen, acted, values, log_probs = [], [], [], []
    with torch.no_grad():
        for step in range(steps):
            samples = [space.sample() for _ in range(count)]
            obs: Any = (
                {key: np.stack([sample[key] for sample in samples]) for key in samples[0]}
                if isinstance(space, spaces.Dict)
                else np.stack(samples)
            )
            seen.append(policy.obs_to_tensor(obs)[0])
            action, value, log_prob, states = policy(seen[-1], states, starts[step])
            acted.append(action)
            values.append(value)
            log_probs.append(log_prob)
        sequence: Any = (
            {key: torch.cat([obs[key] for obs in seen]) for key in seen[0]}
            if isinstance(space, spaces.Dict)
            else torch.cat(seen)
        )
        all_values, all_log_probs, _ = policy.evaluate_actions(sequence, torch.cat(acted), before, starts)
    torch.testing.assert_close(all_values, torch.cat(values))
    torch.testing.assert_close(all_log_probs, torch.cat(log_probs))


def test_predict_remembers_until_an_episode_starts() -> None:
    policy = make(box(3), box(2))
    first, second = np.ones((2, 3), np.float32), np.full((2, 3), -1.0, np.float32)
    _, state = policy.predict(first, deterministic=True)
    remembering, _ = policy.predict(second, state, np.array([False, True]), deterministic=True)
    fresh, _ = policy.predict(second, deterministic=True)
    assert not np.allclose(remembering[0], fresh[0])
    np.testing.assert_allclose(remembering[1], fresh[1], atol=1e-6)


def test_predict_takes_one_or_many() -> None:
    policy = make(STREET_WITH_TRAITS)
    many = {key: value.numpy() for key, value in scene(4).items()}
    actions, (hidden,) = policy.predict(many, deterministic=True)
    assert actions.shape == (4,) and hidden.shape == (4, SMALL.hidden_size)
    one, state = policy.predict({key: value[2] for key, value in many.items()}, deterministic=True)
    assert one.shape == () and one == actions[2]
    np.testing.assert_allclose(state[0][0], hidden[2], atol=1e-6)


def test_attention_weights_for_plotting() -> None:
    policy = make(STREET_WITH_TRAITS)
    many = {key: value.numpy() for key, value in scene(4).items()}
    weights = policy.attention_weights(many)
    assert weights.shape == (4, 12)
    one = policy.attention_weights({key: value[2] for key, value in many.items()})
    np.testing.assert_allclose(one, weights[2], atol=1e-6)
    with pytest.raises(InputError, match="no attention"):
        make(box(3)).attention_weights(many)


def test_bfloat16_is_for_training_only() -> None:
    exact, rounded = make(STREET_WITH_TRAITS), make(STREET_WITH_TRAITS, use_bfloat16=True)
    observations, starts, actions = scene(8), torch.zeros(1, 8), torch.zeros(8)

    def log_probs(policy: GruPolicy, training: bool) -> Tensor:
        policy.set_training_mode(training)
        return policy.evaluate_actions(observations, actions, policy.initial_states(8), starts)[1]

    assert torch.equal(log_probs(exact, training=False), log_probs(rounded, training=False))
    assert not torch.equal(log_probs(exact, training=True), log_probs(rounded, training=True))
    torch.testing.assert_close(log_probs(exact, training=True), log_probs(rounded, training=True), atol=0.01, rtol=0.01)


def test_policy_save_and_load(tmp_path: Path) -> None:
    policy = make(STREET_WITH_TRAITS, use_bfloat16=True)
    policy.save(str(tmp_path / "policy.pt"))
    loaded = GruPolicy.load(str(tmp_path / "policy.pt"), device="cpu")
    assert loaded.settings == SMALL and loaded.use_bfloat16
    for name, value in policy.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name])


def test_without_attention_all_vehicles_count_the_same() -> None:
    extractor = AttentionExtractor(STREET_WITH_TRAITS, replace(SMALL, attention=False))
    observations = scene(6)
    real = observations["mask"] > 0.5
    torch.testing.assert_close(extractor.attention(observations), real / real.sum(-1, keepdim=True).clamp(min=1))
    assert extractor.score is None
    assert torch.isfinite(extractor(observations)).all()


def test_only_the_critic_sees_true_traits() -> None:
    space = spaces.Dict({**STREET_WITH_TRAITS.spaces, TRUE_TRAITS: box(12, 2)})
    policy = make(space, settings=SMALL)
    observations = {**scene(5), TRUE_TRAITS: torch.zeros(5, 12, 2)}
    other = {**observations, TRUE_TRAITS: torch.ones(5, 12, 2)}
    state, starts = policy.initial_states(5), torch.zeros(5)
    with torch.no_grad():
        assert not torch.allclose(
            policy.predict_values(observations, state, starts), policy.predict_values(other, state, starts)
        )
        first, second = (policy.get_distribution(one, state, starts)[0] for one in (observations, other))
        torch.testing.assert_close(first.distribution.logits, second.distribution.logits)
    seen = {key: value.numpy() for key, value in scene(5).items()}
    actions, _ = policy.predict(seen, deterministic=True)  # an actor in use has no true traits
    assert actions.shape == (5,)


def test_quick_tanh_is_tanh() -> None:
    inputs = torch.tensor([-200.0, -3.0, -1e-3, 0.0, 0.5, 2.0, 200.0], requires_grad=True)
    found, expected = QuickTanh()(inputs), inputs.tanh()
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0.0)
    gradients = [torch.autograd.grad(outputs.square().sum(), inputs)[0] for outputs in (found, expected)]
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=0.0)
