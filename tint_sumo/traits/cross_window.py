"""Method ``cross_window``: a latent that must predict another window of the same driver, learnt without labels."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.config import LATENT_SIZE, MIN_WINDOW_STEPS, WINDOW_STEPS, TraitSettings
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import kl_divergence, sample
from tint_sumo.traits.model import FEATURES, TraitModel, register, valid_steps

SAMPLES = 8  # latents per window in the estimate of the predictive likelihood
KL_WEIGHT = 0.01  # just enough to keep the latents near the standard normal prior
LOG_STD_RANGE = (-4.0, 3.0)  # limits for predicted features: the density of a perfect prediction stays below exp(4)


@register
class CrossWindow(TraitModel):
    """GRU encoder, and a GRU decoder that follows ANOTHER window of the driver and predicts its next displacements.

    A trait is what stays the same from one window of a driver to the next. What happens in a window alone, such as the
    noise of its positions or where the leader brakes, does not help to predict another one, so the latent drops it,
    while a latent that must reconstruct its own window has to keep it.

    The loss is the negative log-likelihood of the other window B given this one, A, -log E_{z ~ q(z|A)} p(B | z),
    estimated with ``SAMPLES`` latents. It is a proper score of the predictive distribution, so that the variance of
    q(z|A) is the uncertainty that A leaves (the maximum-likelihood objective of neural processes, Foong et al., 2020):
    an evidence lower bound would rather have a sure latent between two candidates.

    Longer tracks are cut into windows, whose Gaussians multiply (``fuse``).
    """

    method = "cross_window"
    uses_other_window = True
    unused_settings = ("kl_weight", "reconstruction_weight")

    def __init__(self, settings: TraitSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__(settings, latent_size)
        self.follower = nn.GRU(FEATURES, settings.hidden_size)
        self.from_follower = nn.Linear(settings.hidden_size, settings.decoder_output_size)
        self.from_latent = nn.Linear(latent_size, settings.decoder_output_size, bias=False)
        self.prediction = nn.Linear(settings.decoder_output_size, 2)

    def encode(self, states: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, each (N, latent_size), of tracks of any length (N, T, 2)."""
        if states.shape[1] <= WINDOW_STEPS:
            return super().encode(states, length)
        pieces = -(-states.shape[1] // WINDOW_STEPS)
        padded = functional.pad(states, (0, 0, 0, pieces * WINDOW_STEPS - states.shape[1]))
        lengths = (length.unsqueeze(1) - WINDOW_STEPS * torch.arange(pieces)).clamp(0, WINDOW_STEPS)
        mean, log_var = super().encode(padded.reshape(-1, WINDOW_STEPS, 2), lengths.flatten().clamp(min=1))
        shape = (len(states), pieces, self.latent_size)
        return fuse(mean.view(shape), log_var.view(shape), lengths >= MIN_WINDOW_STEPS)

    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """Terms ``kl`` and ``prediction``, the negative log-likelihood of the other window, in nats per window."""
        mean, log_var = self.encode(batch.states, batch.length)
        latents = sample(mean, log_var, generator, SAMPLES)
        displacement, log_std, target, valid = self._predict(batch, latents)
        log_density = -0.5 * ((target - displacement) * torch.exp(-log_std)).square() - log_std
        per_window = torch.where(valid, log_density, 0.0).sum(dim=1)
        prediction = math.log(SAMPLES) - per_window.logsumexp(dim=0)
        terms = {"kl": kl_divergence(mean, log_var).mean(), "prediction": prediction.mean()}
        return {**terms, "total": terms["prediction"] + KL_WEIGHT * terms["kl"]}

    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Errors of the next positions in the other windows, each predicted from the true ones before it."""
        mean, _ = self.encode(batch.states, batch.length)
        displacement, _, target, valid = self._predict(batch, mean.unsqueeze(0))
        return ((displacement[0] - target)[valid] * self.feature_scale[0]).square()

    def _predict(self, batch: WindowBatch, latents: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The other windows' scaled displacements from their second step on, T - 1 of them.

        Args:
            batch: N windows and others.
            latents: (K, N, latent_size).

        Returns:
            Predictions and the logarithms of their standard deviations (K, T - 1, N), true displacements and which of
            them are valid (T - 1, N).
        """
        assert batch.other is not None
        features = self.features(batch.other.states, batch.other.length)
        followed, _ = self.follower(features[:, :-1].transpose(0, 1))
        joined = self.from_follower(followed) + self.from_latent(latents).unsqueeze(1)
        displacement, log_std = self.prediction(joined.relu()).float().unbind(dim=-1)
        valid = valid_steps(features, batch.other.length)[:, 1:].T
        return displacement, log_std.clamp(*LOG_STD_RANGE), features[:, 1:, 0].T, valid


def fuse(mean: Tensor, log_var: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """What several windows of one driver say together: mean and log-variance (N, latent_size).

    Windows are independent given the trait, so the posterior is the product of theirs, with the prior N(0, 1) counted
    once. A window cannot say less than the prior does.

    Args:
        mean, log_var: (N, P, latent_size) of P windows.
        valid: (N, P), which of them count; with none, the prior is returned.
    """
    precision = torch.where(valid.unsqueeze(-1), torch.exp(-log_var).clamp(min=1.0), 0.0)
    total = 1.0 + (precision - 1.0).clamp(min=0.0).sum(dim=1)
    weighted = (precision * mean).sum(dim=1)
    return weighted / total, -torch.log(total)
