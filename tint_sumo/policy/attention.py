"""Attention over the vehicles that are there, with its derivative written by hand for speed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

_FAR_BELOW = -1e9  # score of an empty slot; finite, so that a street without vehicles gives no NaN
_BLOCK = 256  # rows: oneDNN compiles a product for each shape it meets, so there should be few of them


@dataclass(frozen=True)
class Packing:
    """The vehicles of B streets with V slots, one after the other, padded to R rows."""

    slots: Tensor  # (vehicles,) flat index of each vehicle's slot, ascending
    rows: Tensor  # (R,) street of each row, B in padding
    starts: Tensor  # (B + 1,) first row of each street, and the number of vehicles
    real: Tensor  # (B, V) bool, which slots hold a vehicle

    @classmethod
    def of(cls, mask: Tensor) -> "Packing":
        """Return the packing for a mask (B, V)."""
        real = mask > 0.5
        slots = real.flatten().nonzero().squeeze(-1)
        streets, columns = mask.shape
        padding = -len(slots) % _BLOCK if torch.is_grad_enabled() else 0
        rows = slots // columns
        if padding:
            rows = functional.pad(rows, (0, padding), value=streets)
        starts = functional.pad(real.sum(-1).cumsum(0), (1, 0))
        return cls(slots, rows, starts, real)

    def pack(self, values: Tensor) -> Tensor:
        """Return the rows (R, F) of values (B, V, F), zeros in padding."""
        chosen = values.flatten(0, 1).index_select(0, self.slots)
        padding = len(self.rows) - len(chosen)
        return functional.pad(chosen, (0, 0, 0, padding)) if padding else chosen

    def spread(self, values: Tensor) -> Tensor:
        """Return the rows (R, F) of values (B, F) of the streets, zeros in padding."""
        padded = len(self.rows) > len(self.slots)
        return (functional.pad(values, (0, 0, 0, 1)) if padded else values).index_select(0, self.rows)

    def sums(self, values: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return sums (B, F) over each street's rows of values (R, F), each times its weight (R,)."""
        order = torch.arange(len(self.slots), device=values.device)
        weights = None if weights is None else weights[: len(order)]
        return functional.embedding_bag(
            order, values, self.starts, mode="sum", include_last_offset=True, per_sample_weights=weights
        )

    def shares(self, dtype: torch.dtype) -> Tensor:
        """Return 1 divided by the number of each street's vehicles (B, 1), by 1 without any."""
        return self.real.sum(-1, keepdim=True).clamp(min=1).to(dtype).reciprocal()

    def dense(self, scores: Tensor) -> Tensor:
        """Return scores (R,) by slot (B, V), in float32 at least, and far below all others in empty slots."""
        dtype = torch.promote_types(scores.dtype, torch.float32)
        dense = scores.new_full(self.real.shape, _FAR_BELOW, dtype=dtype)
        dense.view(-1).index_copy_(0, self.slots, scores[: len(self.slots)].to(dtype))
        return dense


class AllSlots(Packing):
    """All slots of B streets as rows, empty ones too, for files of networks: shapes do not depend on the mask."""

    @classmethod
    def of(cls, mask: Tensor) -> "AllSlots":
        none = mask.new_empty(0, dtype=torch.int64)
        return cls(none, none, none, mask > 0.5)

    def pack(self, values: Tensor) -> Tensor:
        return torch.where(self.real.unsqueeze(-1), values, 0.0).flatten(0, 1)

    def spread(self, values: Tensor) -> Tensor:
        return values.unsqueeze(1).expand(-1, self.real.shape[1], -1).flatten(0, 1)

    def sums(self, values: Tensor, weights: Tensor | None = None) -> Tensor:
        weights = self.real.flatten().to(values.dtype) if weights is None else weights
        return (values * weights.unsqueeze(-1)).reshape(*self.real.shape, -1).sum(1)

    def dense(self, scores: Tensor) -> Tensor:
        return torch.where(self.real, scores.reshape(self.real.shape), _FAR_BELOW)


Layers = list[tuple[Tensor, Tensor]]  # weight (outputs, inputs) and bias (outputs,) of linear layers


def linear_layers(*modules: nn.Module) -> Layers:
    """Return weight and bias of all linear layers in some modules, in their order."""
    layers = [layer for module in modules for layer in module.modules() if isinstance(layer, nn.Linear)]
    return [(layer.weight, layer.bias) for layer in layers]


def attend(packing: Packing, inputs: Tensor, embedding: Layers, score: Layers) -> tuple[Tensor, Tensor]:
    """Embed the vehicles of B streets, weigh them and sum them up.

    Each row is embedded as e_i, by linear layers with ReLU. Its score comes from [e_i, mean of e], by linear layers
    with ReLU in between; the weights are the softmax of the scores. Under autocast, matrix products have its type.

    Args:
        packing: which rows are whose.
        inputs: (R, F) of the vehicles, finite in padding.
        embedding: one layer or more.
        score: two layers or more, the last of one output; empty for equal weights.

    Returns:
        The sum of the embeddings, each times its weight (B, E), and the weights (B, V), without gradient, which sum to
        1 over the vehicles and are 0 in empty slots.
    """
    kind = inputs.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else inputs.dtype
    flat = [parameter.to(dtype) for layer in (*embedding, *score) for parameter in layer]
    apply: Any = _Attention.apply
    return cast(tuple[Tensor, Tensor], apply(packing, len(embedding), inputs.to(dtype), *flat))


class _Attention(torch.autograd.Function):
    """Products of large matrices and few passes over them: what autograd would keep or compute twice is not needed."""

    @staticmethod
    def forward(ctx: Any, packing: Packing, depth: int, inputs: Tensor, *flat: Tensor) -> tuple[Tensor, Tensor]:
        embedding, score = _paired(flat[: 2 * depth]), _paired(flat[2 * depth :])
        embeddings = _rectified(inputs, embedding)
        embedded, shares = embeddings[-1], packing.shares(inputs.dtype)
        if score:
            mean = packing.sums(embedded) * shares
            (weight, bias), *further = score
            size = embedded.shape[-1]
            shared = torch.addmm(bias, mean, weight[:, size:].t())  # of all vehicles of a street the same
            first = packing.spread(shared).addmm_(embedded, weight[:, :size].t()).relu_()
            hidden = _rectified(first, further[:-1])
            last_weight, last_bias = further[-1]
            scores = torch.addmv(last_bias, hidden[-1], last_weight[0])
            weights = torch.softmax(packing.dense(scores), dim=-1).mul_(packing.real)
        else:
            mean, hidden = embedded[:0], []
            weights = packing.real * packing.shares(torch.promote_types(inputs.dtype, torch.float32))
        rows = packing.pack(weights.unsqueeze(-1)).squeeze(-1).to(embedded.dtype)
        sums = packing.sums(embedded, rows)
        ctx.packing, ctx.depth = packing, depth
        ctx.save_for_backward(*flat, rows, shares, mean, sums, *embeddings, *hidden)
        ctx.mark_non_differentiable(weights)
        return sums, weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_sums: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        packing, depth = ctx.packing, ctx.depth
        saved = list(ctx.saved_tensors)
        count = len(ctx.needs_input_grad) - 3
        flat, (weights, shares, mean, sums), activations = saved[:count], saved[count : count + 4], saved[count + 4 :]
        embedding, score = _paired(flat[: 2 * depth]), _paired(flat[2 * depth :])
        embeddings, hidden = activations[: depth + 1], activations[depth + 1 :]
        embedded = embeddings[-1]
        grad = packing.spread(grad_sums)
        score_grads: list[Tensor] = []
        if score:
            (weight, _), *further = score
            last_weight, _ = further[-1]
            size = embedded.shape[-1]
            # The softmax's derivative; the sum of weight times gradient over a street is grad_sums . sums.
            beyond = (
                (grad * embedded).sum(-1).sub_(packing.spread((grad_sums * sums).sum(-1, keepdim=True)).squeeze(-1))
            )
            grad_scores = beyond.mul_(weights)
            last = [(grad_scores @ hidden[-1]).unsqueeze(0), grad_scores.sum().unsqueeze(0)]
            outer = torch.outer(grad_scores, last_weight[0])
            grad_first, between = _rectified_gradients(outer, hidden, further[:-1], with_first=True)
            assert grad_first is not None
            _through_relu(grad_first, hidden[0])
            grad_shared = packing.sums(grad_first)
            grad_weight = torch.cat([grad_first.t() @ embedded, grad_shared.t() @ mean], dim=-1)
            score_grads = [grad_weight, grad_shared.sum(0), *between, *last]
            grad.mul_(weights.unsqueeze(-1)).add_(packing.spread((grad_shared @ weight[:, size:]).mul_(shares)))
            grad.addmm_(grad_first, weight[:, :size])
        else:
            grad.mul_(weights.unsqueeze(-1))
        grad_inputs, grads = _rectified_gradients(grad, embeddings, embedding, with_first=ctx.needs_input_grad[2])
        return (None, None, grad_inputs, *grads, *score_grads)


def _paired(flat: Sequence[Tensor]) -> Layers:
    return list(zip(flat[::2], flat[1::2], strict=True))


def _rectified(inputs: Tensor, layers: Layers) -> list[Tensor]:
    """Return inputs (R, F) and what each linear layer makes of them, followed by ReLU."""
    activations = [inputs]
    for weight, bias in layers:
        activations.append(torch.addmm(bias, activations[-1], weight.t()).relu_())
    return activations


def _rectified_gradients(
    grad: Tensor, activations: list[Tensor], layers: Layers, *, with_first: bool
) -> tuple[Tensor | None, list[Tensor]]:
    """Return gradients of ``_rectified``: of the inputs, if asked for, and of each layer's weight and bias.

    Args:
        grad: of the last activation; overwritten.
        activations: what ``_rectified`` has returned.
        layers: as there.
        with_first: whether the inputs' gradient is needed.
    """
    grads: list[Tensor] = []
    for number in reversed(range(len(layers))):
        grad = _through_relu(grad, activations[number + 1])
        grads = [grad.t() @ activations[number], grad.sum(0), *grads]
        if number or with_first:
            grad = grad @ layers[number][0]
    return (grad if with_first else None), grads


def _through_relu(grad: Tensor, output: Tensor) -> Tensor:
    """Return ``grad``, overwritten, with 0 where ReLU's output is 0."""
    return cast(Tensor, torch.ops.aten.threshold_backward.grad_input(grad, output, 0.0, grad_input=grad))
