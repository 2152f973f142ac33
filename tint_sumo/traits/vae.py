"""Method ``vae``: the variational autoencoder of the paper (III-B)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.config import LATENT_SIZE, TraitSettings
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import kl_divergence, perceptron, sample
from tint_sumo.traits.model import FEATURES, TraitModel, register, valid_steps

START_OF_SEQUENCE = -2.0  # value of both features before the first step (code)


@register
class Vae(TraitModel):
    """GRU encoder and GRU decoder around a Gaussian latent (paper III-B2, equations 1-4; layer sizes: code).

    The decoder is autoregressive on its own reconstruction and sees [x_hat(t-1), z] at every step, beginning with a
    start-of-sequence state. It ends in a linear layer, not in the authors' tanh, because scaled features have no
    bounds.
    """

    method = "vae"

    def __init__(self, settings: TraitSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__(settings, latent_size)
        sizes = (FEATURES + latent_size, *settings.embedding_sizes)
        self.decoder_embed = perceptron(*sizes)
        self.decoder = nn.GRUCell(sizes[-1], settings.hidden_size)
        self.decoder_output = nn.Sequential(
            *perceptron(settings.hidden_size, settings.decoder_output_size),
            nn.Linear(settings.decoder_output_size, FEATURES),
        )

    def decode(self, latent: Tensor, steps: int) -> Tensor:
        """Return reconstructed features (N, steps, 2) of latents (N, latent_size)."""
        state = latent.new_full((len(latent), FEATURES), START_OF_SEQUENCE)
        hidden = latent.new_zeros(len(latent), self.settings.hidden_size)
        states = []
        for _ in range(steps):
            hidden = self.decoder(self.decoder_embed(torch.cat((state, latent), dim=1)), hidden)
            state = self.decoder_output(hidden)
            states.append(state)
        return torch.stack(states, dim=1)

    def reconstruct(self, states: Tensor, length: Tensor) -> Tensor:
        """Return offset and gap (N, T, 2) in m as decoded from the latent means of windows."""
        decoded = self.decode(self.encode(states, length)[0], states.shape[1])
        displacement, gap = (decoded * self.feature_scale + self.feature_mean).unbind(dim=-1)
        offset = displacement[:, 1:].cumsum(dim=1)
        return torch.stack((functional.pad(offset, (1, 0)), gap), dim=-1)

    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """Return ``kl`` (nats per window) and ``reconstruction`` (mean square of the features of valid steps)."""
        features = self.features(batch.states, batch.length)
        mean, log_var = self.encoder(features, batch.length)
        decoded = self.decode(sample(mean, log_var, generator)[0], features.shape[1])
        valid = valid_steps(batch.states, batch.length)
        terms = {
            "kl": kl_divergence(mean, log_var).mean(),
            "reconstruction": functional.mse_loss(decoded[valid], features[valid]),
        }
        total = self.settings.kl_weight * terms["kl"] + self.settings.reconstruction_weight * terms["reconstruction"]
        return {**terms, "total": total}

    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Return errors of the reconstructed offsets, from the second step on."""
        offset = self.reconstruct(batch.states, batch.length)[..., 0]
        moving = valid_steps(batch.states, batch.length)[:, 1:]
        return (offset - batch.states[..., 0])[:, 1:][moving].square()
