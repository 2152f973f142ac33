"""Method ``ours``: the variational autoencoder of the paper (III-B)."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.config import LATENT_SIZE, VaeSettings
from tint_sumo.traits.model import FEATURES, TraitModel, register, valid_steps

START_OF_SEQUENCE = -2.0  # of both features (code)
INITIAL_LOG_VAR = -4.0  # of the latent: noise as wide as the prior would drown the means while they take shape


@register
class Vae(TraitModel):
    """GRU encoder and GRU decoder around a Gaussian latent (paper III-B2, equations 1-4; layer sizes: code).

    The decoder is autoregressive on its own reconstruction and sees [x_hat(t-1), z] at every step, beginning with a
    start-of-sequence state. It ends in a linear layer, not in the authors' tanh, because scaled features have no
    bounds.
    """

    method = "ours"

    def __init__(self, settings: VaeSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__(settings, latent_size)
        embedding, hidden = settings.embedding_sizes[-1], settings.hidden_size
        self.embed = perceptron(FEATURES, *settings.embedding_sizes)
        self.encoder = nn.GRU(embedding, hidden)
        self.summary = perceptron(hidden, settings.encoder_output_size)
        self.mean_head = nn.Linear(settings.encoder_output_size, latent_size)
        self.log_var_head = nn.Linear(settings.encoder_output_size, latent_size)
        nn.init.constant_(self.log_var_head.bias, INITIAL_LOG_VAR)

        first = settings.embedding_sizes[0]
        self.decoder_state_input = nn.Linear(FEATURES, first, bias=False)
        self.decoder_latent_input = nn.Linear(latent_size, first)
        self.decoder_embed = nn.Sequential(nn.ReLU(), *perceptron(*settings.embedding_sizes))
        self.decoder = nn.GRUCell(embedding, hidden)
        self.decoder_output = nn.Sequential(
            *perceptron(hidden, settings.decoder_output_size), nn.Linear(settings.decoder_output_size, FEATURES)
        )

    def encode(self, states: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        return self._encode_features(self.features(states, length), length)

    def _encode_features(self, features: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        hidden, _ = self.encoder(self.embed(features.transpose(0, 1)))
        last = hidden[length - 1, torch.arange(len(length), device=length.device)]
        summary = self.summary(last)
        return self.mean_head(summary).float(), self.log_var_head(summary).float()

    def decode(self, latent: Tensor, steps: int) -> Tensor:
        """Reconstructed features (N, steps, 2) of latents (N, latent_size)."""
        from_latent = self.decoder_latent_input(latent)  # the same at every step
        state = latent.new_full((len(latent), FEATURES), START_OF_SEQUENCE)
        hidden = latent.new_zeros(len(latent), self.settings.hidden_size)
        states = []
        for _ in range(steps):
            hidden = self.decoder(self.decoder_embed(from_latent + self.decoder_state_input(state)), hidden)
            state = self.decoder_output(hidden)
            states.append(state)
        return torch.stack(states, dim=1)

    def loss(self, states: Tensor, length: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Terms ``kl`` (nats per window) and ``reconstruction`` (mean square of the features of valid steps)."""
        features = self.features(states, length)
        mean, log_var = self._encode_features(features, length)
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        decoded = self.decode(mean + noise * torch.exp(0.5 * log_var), states.shape[1])
        valid = valid_steps(states, length)
        terms = {
            "kl": kl_divergence(mean, log_var).mean(),
            "reconstruction": functional.mse_loss(decoded[valid], features[valid]),
        }
        total = self.settings.kl_weight * terms["kl"] + self.settings.reconstruction_weight * terms["reconstruction"]
        return {**terms, "total": total}


def perceptron(*sizes: int) -> nn.Sequential:
    """Linear layers from each size to the next, each followed by ReLU."""
    return nn.Sequential(*(layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), nn.ReLU())))


def kl_divergence(mean: Tensor, log_var: Tensor) -> Tensor:
    """KL(N(mean, exp(log_var)) || N(0, 1)) in nats, summed over the last dimension."""
    return 0.5 * (mean.square() + log_var.exp() - log_var - 1.0).sum(dim=-1)
