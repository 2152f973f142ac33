"""The steps of a GRU and of its derivative, compiled: with small batches, calls of torch take longer than the sums.

All arrays are float32 of T steps, N sequences and hidden size H; gates stand in torch's order reset, update, candidate.
Rows of states are padded to an even number and columns to a multiple of 4, so that products go two rows and four terms
at a time.
"""

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.compiling import fused

Array = NDArray[np.float32]

_ONE, _HALF, _LARGE = np.float32(1.0), np.float32(0.5), np.float32(7.9)


@fused
def run(
    projected: Array, keep: Array, bias: Array, weight: Array, states: Array, gates: Array, recurrent: Array
) -> None:
    """Run over all steps.

    Args:
        projected: (T, N, 3 H) inputs of the gates from outside, with their bias.
        keep: (T, N), 0 where the state is zeroed before the step.
        bias: (3 H,) of the recurrent products.
        weight: (H padded, 3 H) transposed recurrent weights, 0 in padding.
        states: (T + 1, N, H); the first is given, the others are written.
        gates: (T, N, 3 H), written: reset, update and candidate.
        recurrent: (T, N, H), written: the candidate's recurrent part, before the reset gate.
    """
    steps, count, size = recurrent.shape
    previous = np.zeros((count + count % 2, weight.shape[0]), np.float32)
    product = np.empty((count + count % 2, 3 * size), np.float32)
    for step in range(steps):
        for row in range(count):
            for at in range(size):
                previous[row, at] = states[step, row, at] * keep[step, row]
        product[:] = bias
        _add_product(previous, weight, product)
        for row in range(count):
            source, summed, gate = projected[step, row], product[row], gates[step, row]
            for at in range(2 * size):
                gate[at] = _HALF + _HALF * _tanh(_HALF * (source[at] + summed[at]))
            for at in range(size):
                recurrent[step, row, at] = summed[2 * size + at]
                candidate = _tanh(source[2 * size + at] + gate[at] * summed[2 * size + at])
                gate[2 * size + at] = candidate
                states[step + 1, row, at] = candidate + gate[size + at] * (previous[row, at] - candidate)


@fused
def run_back(
    grad_outputs: Array,
    keep: Array,
    weight: Array,
    states: Array,
    gates: Array,
    recurrent: Array,
    grad_projected: Array,
    grad_products: Array,
    previous: Array,
    grad_hidden: Array,
) -> None:
    """Go back over all steps.

    Args:
        grad_outputs: (T, N, H) gradients of the states after each step.
        keep: as in ``run``.
        weight: (3 H padded, H) recurrent weights, 0 in padding.
        states: as in ``run``, all of them.
        gates: as in ``run``.
        recurrent: as in ``run``.
        grad_projected: (T, N, 3 H), written.
        grad_products: (T, N, 3 H), written: gradients of the recurrent products.
        previous: (T, N, H), written: the states that these products were made of.
        grad_hidden: (N, H), written: gradient of the first state.
    """
    steps, count, size = recurrent.shape
    products = np.zeros((count + count % 2, weight.shape[0]), np.float32)
    through = np.zeros((count + count % 2, size), np.float32)  # gradient of the state after the step
    for step in range(steps - 1, -1, -1):
        for row in range(count):
            gate, source, product = gates[step, row], grad_projected[step, row], products[row]
            kept = keep[step, row]
            for at in range(size):
                grad = through[row, at] + grad_outputs[step, row, at]
                before = states[step, row, at] * kept
                reset, update, candidate = gate[at], gate[size + at], gate[2 * size + at]
                of_candidate = grad * (_ONE - update) * (_ONE - candidate * candidate)
                of_update = grad * (before - candidate) * update * (_ONE - update)
                of_reset = of_candidate * recurrent[step, row, at] * reset * (_ONE - reset)
                previous[step, row, at] = before
                source[at], source[size + at], source[2 * size + at] = of_reset, of_update, of_candidate
                product[at], product[size + at], product[2 * size + at] = of_reset, of_update, of_candidate * reset
                through[row, at] = grad * update
            for at in range(3 * size):
                grad_products[step, row, at] = product[at]
        _add_product(products, weight, through)
        for row in range(count):
            for at in range(size):
                through[row, at] *= keep[step, row]
    for row in range(count):
        for at in range(size):
            grad_hidden[row, at] = through[row, at]


@fused
def _add_product(left: Array, right: Array, total: Array) -> None:
    """Add a product of matrices to ``total``; ``left`` has an even number of rows and a multiple of 4 columns."""
    for row in range(0, left.shape[0], 2):
        one, other, one_total, other_total = left[row], left[row + 1], total[row], total[row + 1]
        for term in range(0, left.shape[1], 4):
            a, b, c, d = one[term], one[term + 1], one[term + 2], one[term + 3]
            e, f, g, h = other[term], other[term + 1], other[term + 2], other[term + 3]
            for at in range(total.shape[1]):
                w, x, y, z = right[term, at], right[term + 1, at], right[term + 2, at], right[term + 3, at]
                one_total[at] = one_total[at] + a * w + b * x + c * y + d * z
                other_total[at] = other_total[at] + e * w + f * x + g * y + h * z


@fused
def _tanh(x: np.float32) -> np.float32:
    """Return tanh to 3e-7, by the rational function of Eigen and XLA; NaN of NaN."""
    x = _LARGE if x > _LARGE else (-_LARGE if x < -_LARGE else x)
    y = x * x
    p = np.float32(-2.76076847742355e-16)
    p = p * y + np.float32(2.00018790482477e-13)
    p = p * y + np.float32(-8.60467152213735e-11)
    p = p * y + np.float32(5.12229709037114e-08)
    p = p * y + np.float32(1.48572235717979e-05)
    p = p * y + np.float32(6.37261928875436e-04)
    p = p * y + np.float32(4.89352455891786e-03)
    q = np.float32(1.19825839466702e-06)
    q = q * y + np.float32(1.18534705686654e-04)
    q = q * y + np.float32(2.26843463243900e-03)
    q = q * y + np.float32(4.89352518554385e-03)
    return x * p / q
