"""The recurrent network from a window to a Gaussian over latent traits, shared by all methods."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from tint_sumo.config import TraitSettings

INITIAL_LOG_VAR = -4.0  # starts small: noise as wide as the prior would hide the means while they are learnt


class WindowEncoder(nn.Module):
    """Embedding, GRU and two linear heads (paper III-B2; layer sizes: code)."""

    def __init__(self, features: int, settings: TraitSettings, latent_size: int) -> None:
        super().__init__()
        self.embed = perceptron(features, *settings.embedding_sizes)
        self.gru = nn.GRU((features, *settings.embedding_sizes)[-1], settings.hidden_size)
        self.summary = perceptron(settings.hidden_size, settings.encoder_output_size)
        self.mean_head = nn.Linear(settings.encoder_output_size, latent_size)
        self.log_var_head = nn.Linear(settings.encoder_output_size, latent_size)
        nn.init.constant_(self.log_var_head.bias, INITIAL_LOG_VAR)

    def forward(self, features: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance, each (N, latent_size) float32, of features (N, T, F) of lengths (N,) >= 1."""
        embedded = self.embed(features.transpose(0, 1))
        if torch.is_grad_enabled():
            last = self.gru(embedded)[0][length - 1, torch.arange(len(length), device=length.device)]
        else:
            last = last_states(self.gru, embedded, length)
        return self.heads(last)

    def step(self, features: Tensor, hidden: Tensor) -> Tensor:
        """Return hidden states (N, hidden) after one more step of features (N, F)."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.gru.all_weights[0]
        return torch.gru_cell(self.embed(features), hidden, weight_ih, weight_hh, bias_ih, bias_hh)

    def heads(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance, each (N, latent_size) float32, of hidden states (N, hidden)."""
        summary = self.summary(hidden)
        return self.mean_head(summary).float(), self.log_var_head(summary).float()


def last_states(gru: nn.GRU, inputs: Tensor, length: Tensor) -> Tensor:
    """Return hidden states (N, hidden) of a one-layer GRU after the last step of inputs (T, N, I) of lengths (N,).

    Without gradients and several times as fast as ``gru`` itself: state, input and a constant 1 stand in the rows of
    one matrix, so that a step is one product and a few operations in place on whole rows. The state is kept as
    (h + 1) / 2, for which the candidate's tanh(x) = 2 sigmoid(2 x) - 1 is a plain logistic function.
    """
    steps, windows, size = inputs.shape
    hidden = gru.hidden_size
    weight = inputs.new_zeros(4 * hidden, hidden + size + 1)  # rows: reset, update, candidate from state, from input
    weight_ih, weight_hh, bias_ih, bias_hh = gru.all_weights[0]
    weight[: 3 * hidden, :hidden] = weight_hh
    weight[: 2 * hidden, hidden:-1] = weight_ih[: 2 * hidden]
    weight[3 * hidden :, hidden:-1] = weight_ih[2 * hidden :]
    weight[: 3 * hidden, -1] = bias_hh
    weight[: 2 * hidden, -1] += bias_ih[: 2 * hidden]
    weight[3 * hidden :, -1] = bias_ih[2 * hidden :]
    weight[2 * hidden :] *= 2.0
    weight[:, -1] -= weight[:, :hidden].sum(dim=1)
    weight[:, :hidden] *= 2.0

    columns = inputs.new_empty(steps + 1, hidden + size + 1, windows)
    columns[0, :hidden] = 0.5
    columns[:-1, hidden:-1] = inputs.transpose(1, 2)
    columns[:, -1] = 1.0
    product = inputs.new_empty(4 * hidden, windows)
    reset, update, candidate, from_input = torch.split(product, hidden)
    for now, after in pairwise(columns):
        torch.mm(weight, now, out=product)
        product[: 2 * hidden].sigmoid_()
        candidate.mul_(reset).add_(from_input).sigmoid_()
        torch.lerp(candidate, now[:hidden], update, out=after[:hidden])
    return 2.0 * columns[length, :hidden, torch.arange(windows, device=length.device)] - 1.0


def perceptron(*sizes: int) -> nn.Sequential:
    """Return linear layers from each size to the next, each followed by ReLU."""
    return nn.Sequential(*(layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), nn.ReLU())))


def sample(mean: Tensor, log_var: Tensor, generator: torch.Generator, samples: int = 1) -> Tensor:
    """Return latents (samples, N, latent_size) drawn from N(mean, exp(log_var))."""
    noise = torch.randn(samples, *mean.shape, generator=generator, dtype=mean.dtype)
    return mean + noise * torch.exp(0.5 * log_var)


def kl_divergence(mean: Tensor, log_var: Tensor) -> Tensor:
    """Return KL(N(mean, exp(log_var)) || N(0, 1)) in nats, summed over the last dimension."""
    return 0.5 * (mean.square() + log_var.exp() - log_var - 1.0).sum(dim=-1)
