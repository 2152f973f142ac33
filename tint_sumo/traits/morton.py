"""Method ``morton``: the baseline of the paper (IV-B), after Morton and Kochenderfer (2017)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.config import LATENT_SIZE, STEP_S, TraitSettings
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import kl_divergence, perceptron, sample
from tint_sumo.traits.model import FEATURE_SPREAD, FEATURES, TraitModel, displacement_and_gap, register

POLICY_LAYERS = 3  # hidden layers of decoder_output_size (code: 3 x 128)


@register
class Morton(TraitModel):
    """The encoder of ``vae`` with the acceleration as a third feature; a feedforward policy imitates the driver.

    The policy takes a single state, displacement and gap, and the latent, and gives the acceleration of the next step.
    """

    method = "morton"
    feature_spread = (*FEATURE_SPREAD, 1.0)
    undefined_steps = (1, 0, 2)

    def __init__(self, settings: TraitSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__(settings, latent_size)
        hidden = settings.decoder_output_size
        self.policy = nn.Sequential(
            *perceptron(FEATURES + latent_size, *(hidden,) * POLICY_LAYERS), nn.Linear(hidden, 1)
        )

    def raw_features(self, states: Tensor) -> Tensor:
        """Return displacement (m), gap (m) and acceleration (m/s2)."""
        features = displacement_and_gap(states)
        change = features[..., :1].diff(dim=1, prepend=features[:, :1, :1])
        return torch.cat((features, change / STEP_S**2), dim=-1)

    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """Return ``kl`` (nats per window) and ``imitation`` (mean square of the scaled accelerations)."""
        features = self.features(batch.states, batch.length)
        mean, log_var = self.encoder(features, batch.length)
        chosen, driven = self._accelerations(features, sample(mean, log_var, generator)[0], batch.length)
        imitation = functional.mse_loss(chosen, driven) if len(driven) else chosen.sum()
        kl = kl_divergence(mean, log_var).mean()
        total = self.settings.kl_weight * kl + self.settings.reconstruction_weight * imitation
        return {"kl": kl, "imitation": imitation, "total": total}

    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Return errors of the next positions, each predicted from the true ones before it."""
        features = self.features(batch.states, batch.length)
        mean, _ = self.encoder(features, batch.length)
        chosen, driven = self._accelerations(features, mean, batch.length)
        return ((chosen - driven) * self.feature_scale[2] * STEP_S**2).square()

    def _accelerations(self, features: Tensor, latent: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return scaled accelerations (M,) from each state with a speed to the next: the policy's and the driver's."""
        states = features[:, 1:-1, :FEATURES]
        joined = torch.cat((states, latent.unsqueeze(1).expand(-1, states.shape[1], -1)), dim=-1)
        known = torch.arange(2, features.shape[1]) < length.unsqueeze(-1)
        return self.policy(joined[known]).squeeze(-1).float(), features[:, 2:, 2][known]
