"""A gated recurrent unit over sequences with resets, fast on a processor."""

from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from tint_sumo.policy.recurrence import run, run_back

_MANY_PRODUCTS = 4_000_000  # of numbers, in one step; with more, torch's products are faster than compiled loops


class ResetGru(nn.Module):
    """One GRU layer whose hidden state is zeroed wherever an episode starts.

    The equations are those of ``torch.nn.GRU``. Unlike there, a reset may come at any step of any sequence, and the
    gradient of the recurrent weights is one matrix product over all steps instead of one a step.
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden_size, input_size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden_size, hidden_size))
        self.bias_ih = nn.Parameter(torch.zeros(3 * hidden_size))
        self.bias_hh = nn.Parameter(torch.zeros(3 * hidden_size))
        nn.init.orthogonal_(self.weight_ih)
        nn.init.orthogonal_(self.weight_hh)

    def forward(self, inputs: Tensor, hidden: Tensor, episode_starts: Tensor) -> tuple[Tensor, Tensor]:
        """Run over T steps of N sequences; under autocast, matrix products have its type.

        Args:
            inputs: (T, N, input_size).
            hidden: (N, hidden_size), state before the first step.
            episode_starts: (T, N), 1 where the state is zeroed before the step.

        Returns:
            Outputs (T, N, hidden_size) and the state after the last step (N, hidden_size), float32.
        """
        if len(inputs) == 1 and not torch.is_grad_enabled() and not torch.is_autocast_enabled(inputs.device.type):
            kept = hidden * (1.0 - episode_starts[0].to(hidden.dtype)).unsqueeze(-1)
            state = torch.gru_cell(inputs[0], kept, self.weight_ih, self.weight_hh, self.bias_ih, self.bias_hh)
            return state.unsqueeze(0), state
        projected = nn.functional.linear(inputs, self.weight_ih, self.bias_ih)
        weight_hh = self.weight_hh.to(projected.dtype)
        keep = (1.0 - episode_starts.to(hidden.dtype)).unsqueeze(-1)
        recurrence: Any = (_CompiledRecurrence if _compiles(hidden, weight_hh) else _Recurrence).apply
        outputs = cast(Tensor, recurrence(projected.to(hidden.dtype), hidden, keep, weight_hh, self.bias_hh))
        return outputs, outputs[-1]


class _Recurrence(torch.autograd.Function):
    """The part of a GRU that must go step by step: state and gates as precise as the state, products as the weight."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, hidden: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        size = weight.shape[1]
        gates = torch.empty_like(projected[..., : 2 * size])  # reset and update
        candidates = torch.empty_like(projected[..., :size])
        outputs = torch.empty_like(candidates)
        state, recurrent, product_bias, columns = hidden, [], bias.to(weight.dtype), weight.t().contiguous()
        steps = zip(*(t.unbind(0) for t in (projected, keep, gates, candidates, outputs)), strict=True)
        for project, kept, gate, candidate, output in steps:
            previous = state * kept
            product = torch.addmm(product_bias, previous.to(weight.dtype), columns).to(hidden.dtype)
            torch.add(project[:, : 2 * size], product[:, : 2 * size], out=gate).sigmoid_()
            recurrent.append(product[:, 2 * size :])  # the candidate's recurrent part, before the reset gate
            torch.addcmul(project[:, 2 * size :], gate[:, :size], recurrent[-1], out=candidate).tanh_()
            state = torch.lerp(candidate, previous, gate[:, size:], out=output)
        ctx.save_for_backward(hidden, keep, weight, gates, candidates, torch.stack(recurrent), outputs)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_outputs: Tensor) -> tuple[Tensor, Tensor, None, Tensor, Tensor]:
        hidden, keep, weight, gates, candidates, recurrent, outputs = ctx.saved_tensors
        size = weight.shape[1]
        reset, update = gates.split(size, dim=-1)
        previous = torch.cat([hidden.unsqueeze(0), outputs[:-1]]).mul_(keep)
        # Derivatives of one state by its own gates for all steps at once: only the state's gradient needs the loop.
        candidate_slope = _tanh_slope(1.0 - update, candidates)
        slopes = torch.stack(
            [
                _sigmoid_slope(candidate_slope * recurrent, reset),
                _sigmoid_slope(previous - candidates, update),
                candidate_slope * reset,
            ],
            dim=-2,
        ).to(weight.dtype)
        grad_products = torch.empty_like(slopes)
        grad_states = torch.empty_like(outputs)
        grad_hidden = torch.zeros_like(hidden)
        steps = [t.unbind(0) for t in (grad_outputs, keep, update, slopes, grad_products, grad_states)]
        for grad_output, kept, gate, slope, grad_product, grad_state in zip(*map(reversed, steps), strict=True):
            torch.add(grad_output, grad_hidden, out=grad_state)
            torch.mul(slope, grad_state.to(weight.dtype).unsqueeze(1), out=grad_product)
            through_product = grad_product.flatten(1) @ weight
            grad_hidden = torch.addcmul(through_product.to(hidden.dtype), grad_state, gate).mul_(kept)
        flat = grad_products.flatten(0, 1).flatten(1)
        grad_weight = flat.T @ previous.flatten(0, 1).to(weight.dtype)
        grad_bias = flat.sum(0).to(hidden.dtype)
        grad_products[..., 2, :] = candidate_slope.mul_(grad_states)  # now the gradient of ``projected``
        return grad_products.flatten(2).to(hidden.dtype), grad_hidden, None, grad_weight, grad_bias


class _CompiledRecurrence(torch.autograd.Function):
    """The same in float32 on a processor, for few and small states: one compiled call for all steps."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, hidden: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        steps, (count, size) = len(projected), hidden.shape
        states = torch.cat([hidden.unsqueeze(0), hidden.new_empty(steps, count, size)])
        gates, recurrent = hidden.new_empty(projected.shape), hidden.new_empty(steps, count, size)
        columns = _padded(weight.t())
        run(*_arrays(projected, keep.squeeze(-1), bias, columns, states, gates, recurrent))
        ctx.save_for_backward(keep, weight, states, gates, recurrent)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_outputs: Tensor) -> tuple[Tensor, Tensor, None, Tensor, Tensor]:
        keep, weight, states, gates, recurrent = ctx.saved_tensors
        grad_projected, grad_products = gates.new_empty(2, *gates.shape)
        previous, grad_hidden = recurrent.new_empty(recurrent.shape), recurrent.new_empty(recurrent.shape[1:])
        given = (grad_outputs, keep.squeeze(-1), _padded(weight), states, gates, recurrent)
        run_back(*_arrays(*given, grad_projected, grad_products, previous, grad_hidden))
        flat = grad_products.flatten(0, 1)
        return grad_projected, grad_hidden, None, flat.t() @ previous.flatten(0, 1), flat.sum(0)


def _compiles(hidden: Tensor, weight: Tensor) -> bool:
    """Return whether compiled steps take states and weights, and are faster than torch's."""
    small = len(hidden) * weight.numel() < _MANY_PRODUCTS
    return small and weight.device.type == "cpu" and weight.dtype == hidden.dtype == torch.float32


def _padded(matrix: Tensor) -> Tensor:
    """Return a matrix with rows of zeros up to a multiple of 4."""
    return nn.functional.pad(matrix, (0, 0, 0, -len(matrix) % 4)) if len(matrix) % 4 else matrix


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def _tanh_slope(outer: Tensor, output: Tensor) -> Tensor:
    """Return ``outer`` times the derivative of tanh where it gives ``output``, in one pass."""
    return cast(Tensor, torch.ops.aten.tanh_backward(outer, output))


def _sigmoid_slope(outer: Tensor, output: Tensor) -> Tensor:
    """Return ``outer`` times the derivative of the logistic function where it gives ``output``, in one pass."""
    return cast(Tensor, torch.ops.aten.sigmoid_backward(outer, output))
