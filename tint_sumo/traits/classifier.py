"""Method ``classifier``: the supervised trait classifier of Ma et al. (2020), a baseline of the paper (IV-C)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.config import LATENT_SIZE, TraitSettings
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.model import TraitModel, register


@register
class Classifier(TraitModel):
    """A GRU trained WITH the true traits; its latent is the last layer before the two classes.

    It bounds what a method without labels can reach on the same windows.
    """

    method = "classifier"
    uses_labels = True
    unused_settings = ("kl_weight", "reconstruction_weight", "decoder_output_size")

    def __init__(self, settings: TraitSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__(settings, latent_size)
        self.output = nn.Linear(latent_size, 1)

    def encode(self, states: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latent and, as it is a point estimate, a log-variance of minus infinity; each (N, latent_size)."""
        mean, log_var = super().encode(states, length)
        return mean, torch.full_like(log_var, -torch.inf)

    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:  # noqa: ARG002
        """Return ``total`` alone, the cross-entropy of the classes in nats."""
        assert batch.conservative is not None
        mean, _ = self.encode(batch.states, batch.length)
        return {"total": functional.binary_cross_entropy_with_logits(self.logit(mean), batch.conservative.float())}

    def logit(self, latents: Tensor) -> Tensor:
        """Return log-odds (N,) of a conservative driver, from latents (N, latent_size)."""
        logit: Tensor = self.output(latents).squeeze(-1).float()
        return logit

    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Return nothing: a classifier predicts no positions."""
        return batch.states.new_empty(0)
