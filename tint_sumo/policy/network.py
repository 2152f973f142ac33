"""The paper's policy network (III-C): attention over vehicles, a recurrent layer, an actor and a critic."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.distributions import CategoricalDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.distributions import Categorical

from tint_sumo.config import PolicySettings
from tint_sumo.core.errors import InputError, NotFiniteError
from tint_sumo.policy.attention import Packing, attend, linear_layers
from tint_sumo.policy.gru import ResetGru
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS
from tint_sumo.traits.encoder import perceptron

OBSERVATION_KEYS = frozenset({"ego", "vehicles", "mask", TRAITS})
_ROAD = ("traffic_light", "right_of_way", "speed_limit", "lane")  # keys that observations may have of the ego's road


class AttentionExtractor(BaseFeaturesExtractor):
    """Features of the ego and the vehicles around it, which count as much as attention gives them.

    Each vehicle's [position, trait, ego state] is embedded as e_i; its score comes from [e_i, mean of e]; the sum of
    the e_i, weighted by the softmax of the scores, joins the ego state. Sizes are those of the authors' code
    (``PolicySettings``).

    Decisions where the sources differ:

    - The paper calls the score itself the weight; the code applies softmax over the vehicles, as here.
    - The code's softmax and mean include empty slots. Here neither does, and empty slots are not even computed: what
      they hold has no influence. With no vehicle at all the weighted sum is zero.
    - Without attention (``PolicySettings.attention``) the weights are equal.
    - The code puts a ReLU on the scores before the softmax and passes each e_i through a 100-100-50 network before the
      sum. Here scores may be negative, and the sum is of the e_i, as in the paper, before one 100-50 layer.

    What else is observed of the ego's road (``tint_sumo.envs.perceived``) joins the ego state in the last layers.

    Args:
        observation_space: Dict of ego (E,), vehicles (V, 2), mask (V,) and traits (V, Z), and keys of the road.
        settings: layer sizes.

    Raises:
        InputError: the observation space lacks one of these.
    """

    packing: type[Packing] = Packing  # AllSlots for a network that is written as a file

    def __init__(self, observation_space: spaces.Dict, settings: PolicySettings | None = None) -> None:
        settings = settings or PolicySettings()
        super().__init__(observation_space, features_dim=settings.joint_sizes[-1])
        missing = OBSERVATION_KEYS - set(observation_space.spaces)
        if missing:
            raise InputError(
                f"the attention network needs observations with {', '.join(sorted(missing))}; "
                "wrap the environment in TraitObservation"
            )
        ego_size, position_size, trait_size = (_last_axis(observation_space, k) for k in ("ego", "vehicles", "traits"))
        embedded = settings.embedding_sizes[-1]
        self.position_gain = settings.position_gain
        self.sees_priority = "priority" in observation_space.spaces
        vehicle_size = position_size + trait_size + ego_size + int(self.sees_priority)
        self.embed = perceptron(vehicle_size, *settings.embedding_sizes)
        self.score = (
            nn.Sequential(*perceptron(2 * embedded, *settings.score_sizes), nn.Linear(settings.score_sizes[-1], 1))
            if settings.attention
            else None
        )
        self.context = perceptron(embedded, settings.context_size)
        self.road = tuple(key for key in _ROAD if key in observation_space.spaces)
        road_size = sum(_last_axis(observation_space, key) for key in self.road)
        self.sees_pedestrians = "pedestrians" in observation_space.spaces
        if self.sees_pedestrians:
            self.embed_pedestrians = perceptron(_last_axis(observation_space, "pedestrians"), settings.context_size)
            road_size += settings.context_size
        self.joint = perceptron(settings.context_size + ego_size + road_size, *settings.joint_sizes)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Return features (B, features_dim) of B observations."""
        weighted, _ = self._attend(observations)
        road = [observations[key] for key in self.road]
        if self.sees_pedestrians:
            road.append(self._largest_of_pedestrians(observations))
        joined = torch.cat([self.context(weighted), self._gained_ego(observations), *road], dim=-1)
        features: Tensor = self.joint(joined)
        return features

    def attention(self, observations: dict[str, Tensor]) -> Tensor:
        """Return attention weights (B, V), which sum to 1 over the vehicles and are 0 in empty slots."""
        return self._attend(observations)[1]

    def _gained_ego(self, observations: dict[str, Tensor]) -> Tensor:
        position, velocity = observations["ego"][..., :2], observations["ego"][..., 2:]
        return torch.cat([position * self.position_gain, velocity], dim=-1)

    def _attend(self, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the sums (B, embedded) of a batch's weighted embeddings, and the weights (B, V)."""
        packing = self.packing.of(observations["mask"])
        parts = [
            packing.pack(observations["vehicles"]) * self.position_gain,
            packing.pack(observations["traits"]),
            packing.spread(self._gained_ego(observations)),
        ]
        if self.sees_priority:
            parts.append(packing.pack(observations["priority"].unsqueeze(-1)))
        score = [] if self.score is None else linear_layers(self.score)
        return attend(packing, torch.cat(parts, dim=-1), linear_layers(self.embed), score)

    def _largest_of_pedestrians(self, observations: dict[str, Tensor]) -> Tensor:
        """Return the largest values (B, F) among the embeddings of a batch's pedestrians, which are 0 or more."""
        position, velocity = observations["pedestrians"][..., :2], observations["pedestrians"][..., 2:]
        embedded = self.embed_pedestrians(torch.cat([position * self.position_gain, velocity], dim=-1))
        largest: Tensor = (embedded * observations["pedestrian_mask"].unsqueeze(-1)).amax(dim=-2)
        return largest


def _with_true_traits(parts: dict[str, Any]) -> dict[str, Any]:
    """Return observations, or their spaces, with the true traits in place of the inferred ones."""
    return {**{key: part for key, part in parts.items() if key != TRUE_TRAITS}, TRAITS: parts[TRUE_TRAITS]}


def _last_axis(space: spaces.Dict, key: str) -> int:
    shape = space[key].shape
    assert shape is not None
    return shape[-1]


class QuickTanh(nn.Module):
    """tanh by the logistic function, which torch computes ten times as fast on a processor."""

    def forward(self, inputs: Tensor) -> Tensor:
        apply: Any = _Tanh.apply
        return cast(Tensor, apply(inputs))


class _Tanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor) -> Tensor:
        outputs = (2.0 * inputs).sigmoid_().mul_(2.0).sub_(1.0)
        ctx.save_for_backward(outputs)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (outputs,) = ctx.saved_tensors
        return cast(Tensor, torch.ops.aten.tanh_backward(grad, outputs))


class GruPolicy(ActorCriticPolicy):
    """Actor and critic on a GRU on a features extractor, for Stable-Baselines3.

    Tensors of sequences are flat, (T * N, ...) with all N sequences of the first step first.

    Where observations hold "true_traits", only the critic sees them: a second attention network, with the true
    traits in place of the inferred ones, adds to the critic's input from the GRU (asymmetric actor-critic, Pinto et al.
    2018). The actor, and so ``predict``, needs no such observation.

    Args:
        observation_space: any; ``AttentionExtractor`` is the default where it fits, else one of Stable-Baselines3's.
        action_space: any that Stable-Baselines3 has a distribution for.
        lr_schedule: learning rate as a function of the progress remaining.
        settings: layer sizes.
        use_bfloat16: in training mode, multiply matrices in bfloat16 in all but the output layers; weights and states
            stay float32, and so does acting, where it gains nothing.
        kwargs: further arguments of ``ActorCriticPolicy``.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *,
        settings: PolicySettings | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        use_bfloat16: bool = False,
        **kwargs: Any,
    ) -> None:
        self.settings = settings or PolicySettings()
        self.use_bfloat16 = use_bfloat16
        extractor = features_extractor_class or _default_extractor(observation_space)
        extractor_kwargs = dict(features_extractor_kwargs or {})
        if issubclass(extractor, AttentionExtractor):
            extractor_kwargs.setdefault("settings", self.settings)
        if not kwargs.keys() & {"optimizer_class", "optimizer_kwargs"}:
            kwargs["optimizer_kwargs"] = {"eps": 1e-5, "fused": True}  # Adam as in Stable-Baselines3, in one pass
        kwargs.setdefault("activation_fn", QuickTanh)
        heads = list(self.settings.head_sizes)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": heads, "vf": heads},
            features_extractor_class=extractor,
            features_extractor_kwargs=extractor_kwargs,
            **kwargs,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        del parameters["net_arch"]
        return {**parameters, "settings": self.settings, "use_bfloat16": self.use_bfloat16}

    def _build_mlp_extractor(self) -> None:
        self.gru = ResetGru(self.features_dim, self.settings.hidden_size)
        self.critic_extractor: AttentionExtractor | None = None
        if isinstance(self.observation_space, spaces.Dict) and TRUE_TRAITS in self.observation_space.spaces:
            seen = _with_true_traits(dict(self.observation_space.spaces))
            self.critic_extractor = AttentionExtractor(spaces.Dict(seen), self.settings)
            self.critic_hint = nn.Linear(self.features_dim, self.settings.hidden_size)
        self.features_dim = self.settings.hidden_size
        super()._build_mlp_extractor()

    def initial_states(self, count: int) -> Tensor:
        """Return hidden states at the start of ``count`` episodes, (count, hidden_size)."""
        return torch.zeros(count, self.settings.hidden_size, device=self.device)

    def _run(self, obs: PyTorchObs, states: Tensor, episode_starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return GRU outputs (T * N, hidden_size) and last states (N, hidden_size); ``episode_starts`` is (T, N)."""
        features = self.extract_features(obs)
        assert isinstance(features, Tensor)
        outputs, states = self.gru(features.view(*episode_starts.shape, -1), states, episode_starts)
        return outputs.flatten(0, 1), states

    def _latent_critic(self, obs: PyTorchObs, outputs: Tensor) -> Tensor:
        """Return the critic's last hidden layer, from observations and the GRU's outputs there."""
        if self.critic_extractor is not None:
            assert isinstance(obs, dict)
            outputs = outputs + self.critic_hint(self.critic_extractor(_with_true_traits(obs)))
        return self.mlp_extractor.forward_critic(outputs)

    def _autocast(self) -> AbstractContextManager[Any]:
        rounded = self.use_bfloat16 and self.training
        return torch.autocast(self.device.type, torch.bfloat16) if rounded else nullcontext()

    def forward(  # type: ignore[override]
        self, obs: PyTorchObs, states: Tensor, episode_starts: Tensor, deterministic: bool = False
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Act one step in N environments.

        Args:
            obs: N observations.
            states: (N, hidden_size).
            episode_starts: (N,), 1 where the observation is the first of an episode.
            deterministic: take the likeliest action instead of a random one.

        Returns:
            Actions (N, ...), values (N, 1), log-probabilities (N,) and new states (N, hidden_size).

        Raises:
            FloatingPointError: what the actions follow from is not finite.
        """
        with self._autocast():
            outputs, states = self._run(obs, states, episode_starts.unsqueeze(0))
            latent_actor = self.mlp_extractor.forward_actor(outputs)
            latent_critic = self._latent_critic(obs, outputs)
        distribution = self._finite_distribution(latent_actor)
        actions = distribution.get_actions(deterministic=deterministic)
        values = self.value_net(latent_critic.float())
        return actions.view(-1, *self._action_shape()), values, distribution.log_prob(actions), states

    def evaluate_actions(  # type: ignore[override]
        self, obs: PyTorchObs, actions: Tensor, states: Tensor, episode_starts: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return values (T * N, 1), log-probabilities (T * N,) and entropies of N sequences of T steps.

        Args:
            obs: T * N observations.
            actions: (T * N, ...), taken there.
            states: (N, hidden_size), before the first step.
            episode_starts: (T, N).
        """
        with self._autocast():
            outputs, _ = self._run(obs, states, episode_starts)
            latent_actor = self.mlp_extractor.forward_actor(outputs)
            latent_critic = self._latent_critic(obs, outputs)
        distribution = self._finite_distribution(latent_actor)
        return self.value_net(latent_critic.float()), distribution.log_prob(actions), distribution.entropy()

    def predict_values(self, obs: PyTorchObs, states: Tensor, episode_starts: Tensor) -> Tensor:  # type: ignore[override]
        """Return values (N, 1) of N observations; arguments as in ``forward``."""
        with self._autocast():
            outputs, _ = self._run(obs, states, episode_starts.unsqueeze(0))
            latent = self._latent_critic(obs, outputs)
        values: Tensor = self.value_net(latent.float())
        return values

    def get_distribution(  # type: ignore[override]
        self, obs: PyTorchObs, states: Tensor, episode_starts: Tensor
    ) -> tuple[Distribution, Tensor]:
        """Return the action distribution and new states of N observations; arguments as in ``forward``."""
        with self._autocast():
            latent, states = self.latent_actor(obs, states, episode_starts)
        return self._finite_distribution(latent), states

    def latent_actor(self, obs: PyTorchObs, states: Tensor, episode_starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actor's last hidden layer and new states of N observations; arguments as in ``forward``."""
        outputs, states = self._run(obs, states, episode_starts.unsqueeze(0))
        return self.mlp_extractor.forward_actor(outputs), states

    def _finite_distribution(self, latent_actor: Tensor) -> Distribution:
        """Return the distribution of actions from the actor's last hidden layer.

        Raises:
            FloatingPointError: that, or what the distribution is made of, is not finite.
        """
        problem = FloatingPointError(
            "the policy's outputs are not finite: its weights or observations are too large or NaN"
        )
        if isinstance(self.action_dist, CategoricalDistribution):  # torch would look at the logits several times
            logits = self.action_net(latent_actor.float())
            if not logits.isfinite().all():
                raise problem
            self.action_dist.distribution = Categorical(logits=logits, validate_args=False)
            return self.action_dist
        if not latent_actor.isfinite().all():
            raise problem
        try:
            return self._get_action_dist_from_latent(latent_actor.float())
        except ValueError:  # torch has looked at the distribution's parameters
            raise problem from None

    @torch.no_grad()
    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Return actions for one observation or a batch, as Stable-Baselines3's policies do.

        Args:
            observation: of one environment or of N.
            state: what the last call returned; None at the beginning.
            episode_start: (N,), true where ``observation`` is the first of an episode.
            deterministic: take the likeliest action instead of a random one.

        Returns:
            The action or N actions, and the state for the next call.

        Raises:
            NotFiniteError: the observation or the weights have numbers that are not finite, or too large.
        """
        self.set_training_mode(False)
        obs, vectorized = self.obs_to_tensor(observation)
        count = len(next(iter(obs.values()))) if isinstance(obs, dict) else len(obs)
        states = self.initial_states(count) if state is None else torch.as_tensor(state[0], device=self.device)
        starts = np.zeros(count, bool) if episode_start is None else np.asarray(episode_start).reshape(count)
        try:
            distribution, states = self.get_distribution(obs, states, torch.as_tensor(starts, device=self.device))
        except FloatingPointError as error:
            raise NotFiniteError(f"{error}; give others") from None
        actions = distribution.get_actions(deterministic=deterministic).view(-1, *self._action_shape()).cpu().numpy()
        if isinstance(self.action_space, spaces.Box):
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return actions if vectorized else actions[0], (states.cpu().numpy(),)

    @torch.no_grad()
    def attention_weights(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return attention weights of one observation (V,) or of N (N, V), for plotting.

        Raises:
            InputError: the policy has no attention.
        """
        if not isinstance(self.features_extractor, AttentionExtractor):
            raise InputError("this policy has no attention; take one with the attention network")
        obs, vectorized = self.obs_to_tensor(observation)
        assert isinstance(obs, dict)
        weights: np.ndarray = self.features_extractor.attention(obs).cpu().numpy()
        return weights if vectorized else weights[0]

    def _action_shape(self) -> tuple[int, ...]:
        assert self.action_space.shape is not None
        return self.action_space.shape


def _default_extractor(space: spaces.Space[Any]) -> type[BaseFeaturesExtractor]:
    if not isinstance(space, spaces.Dict):
        return FlattenExtractor
    return AttentionExtractor if set(space.spaces) >= OBSERVATION_KEYS else CombinedExtractor
