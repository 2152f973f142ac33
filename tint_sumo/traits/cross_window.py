"""Method ``cross_window``: a latent that must predict another window of the same driver, learnt without labels."""

import math

import torch
from torch import Tensor, nn

from tint_sumo.config import LATENT_SIZE, TraitSettings
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import kl_divergence, sample
from tint_sumo.traits.model import FEATURES, TraitModel, register, valid_steps

SAMPLES = 8  # latents per window in the estimate of the predictive likelihood
KL_WEIGHT = 0.01  # just enough to keep the latents near the standard normal prior
LOG_STD_RANGE = (-4.0, 3.0)  # limits for predicted features: the density of a perfect prediction stays below exp(4)


@register
class CrossWindow(TraitModel):
    """GRU encoder, and a GRU decoder that follows ANOTHER window of the driver and predicts its next displacements.

    A trait is what stays the same from one window of a driver to the next. Events in a single window, such as the
    noise of its positions or where the leader brakes, do not help to predict another one, so the latent drops them,
    while a latent that must reconstruct its window has to keep them.

    The loss is the negative log-likelihood of the other window B given this one, A, -log E_{z ~ q(z|A)} p(B | z),
    estimated with ``SAMPLES`` latents. It is a proper score of the predictive distribution, so that the variance of
    q(z|A) is the uncertainty that A leaves (the maximum-likelihood objective of neural processes, Foong et al., 2020):
    an evidence lower bound would rather have a sure latent between two candidates.

    The posteriors of a driver's windows multiply (``tint_sumo.traits.streaming``).
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

    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """Return ``kl`` and ``prediction``, the negative log-likelihood of the other window, in nats per window."""
        mean, log_var = self.encode(batch.states, batch.length)
        latents = sample(mean, log_var, generator, SAMPLES)
        displacement, log_std, target, valid = self._predict(batch, latents)
        log_density = -0.5 * ((target - displacement) * torch.exp(-log_std)).square() - log_std
        per_window = torch.where(valid, log_density, 0.0).sum(dim=1)
        prediction = math.log(SAMPLES) - per_window.logsumexp(dim=0)
        terms = {"kl": kl_divergence(mean, log_var).mean(), "prediction": prediction.mean()}
        return {**terms, "total": terms["prediction"] + KL_WEIGHT * terms["kl"]}

    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Return errors of the next positions in the other windows, each predicted from the true ones before it."""
        mean, _ = self.encode(batch.states, batch.length)
        displacement, _, target, valid = self._predict(batch, mean.unsqueeze(0))
        return ((displacement[0] - target)[valid] * self.feature_scale[0]).square()

    def _predict(self, batch: WindowBatch, latents: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Predict the other windows' scaled displacements from their second step on, T - 1 of them.

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

    @torch.no_grad()
    def ahead_m(self, states: Tensor, latents: Tensor, seen: int) -> Tensor:
        """Predict how far drivers go in the rest of some windows, behind leaders whose motion is known.

        Args:
            states: (N, T, 2) of whole windows.
            latents: (N, latent_size) of their drivers.
            seen: number of steps that are looked at; those after them are predicted one by one.

        Returns:
            (N,) distances in m.
        """
        whole = torch.full((len(states),), states.shape[1])
        features = self.features(states, whole)
        shift = self.from_latent(latents)
        _, hidden = self.follower(features[:, :seen].transpose(0, 1))
        leader_m = states.sum(dim=-1).diff(dim=1)  # displacements of the leader
        gap_m, total_m = states[:, seen - 1, 1], torch.zeros(len(states))
        is_free = states[..., 1].amax(dim=1) >= self.no_leader_gap_m
        for step in range(seen, states.shape[1]):
            joined = self.from_follower(hidden[0]) + shift
            displacement_m = self.prediction(joined.relu())[:, 0] * self.feature_scale[0] + self.feature_mean[0]
            total_m = total_m + displacement_m
            gap_m = torch.where(is_free, gap_m, gap_m + leader_m[:, step - 1] - displacement_m)
            raw = torch.stack((displacement_m, gap_m), dim=-1)
            _, hidden = self.follower(((raw - self.feature_mean) / self.feature_scale).unsqueeze(0), hidden)
        return total_m
