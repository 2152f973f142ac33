import pytest
import torch
from torch import Tensor

from tint_sumo.policy.gru import ResetGru


@pytest.fixture
def gru() -> ResetGru:
    torch.manual_seed(0)
    gru = ResetGru(5, 4).double()
    with torch.no_grad():
        for parameter in gru.parameters():
            parameter.uniform_(-1.0, 1.0)
    return gru


def data() -> tuple[Tensor, Tensor, Tensor]:
    inputs = torch.randn(7, 3, 5, dtype=torch.double, requires_grad=True)
    hidden = torch.randn(3, 4, dtype=torch.double, requires_grad=True)
    starts = torch.zeros(7, 3)
    starts[0, 0] = starts[3, 1] = starts[4, 0] = starts[6, :] = 1.0
    return inputs, hidden, starts


def test_equals_torch_cell_with_resets(gru: ResetGru) -> None:
    inputs, hidden, starts = data()
    cell = torch.nn.GRUCell(5, 4).double()
    cell.load_state_dict(gru.state_dict())
    outputs, last = gru(inputs, hidden, starts)
    for step in range(7):
        hidden = cell(inputs[step], hidden * (1.0 - starts[step])[:, None])
        torch.testing.assert_close(outputs[step], hidden)
    torch.testing.assert_close(last, hidden)


def test_gradients_equal_numerical_ones(gru: ResetGru) -> None:
    inputs, hidden, starts = data()
    names = [name for name, _ in gru.named_parameters()]

    def run(inputs: Tensor, hidden: Tensor, *parameters: Tensor) -> Tensor:
        outputs: Tensor = torch.func.functional_call(
            gru, dict(zip(names, parameters, strict=True)), (inputs, hidden, starts)
        )[0]
        return outputs

    assert torch.autograd.gradcheck(run, (inputs, hidden, *gru.parameters()))


@pytest.mark.parametrize(("count", "size"), [(3, 5), (4, 8), (1, 4)])
def test_compiled_steps_equal_those_of_torch(count: int, size: int) -> None:
    """In float32 the steps are compiled, in double they are torch's; resets come within the sequences."""
    torch.manual_seed(0)
    exact, compiled = ResetGru(6, size).double(), ResetGru(6, size)
    compiled.load_state_dict(exact.state_dict())
    inputs, hidden = torch.randn(9, count, 6), torch.randn(count, size)
    starts = (torch.rand(9, count) < 0.2).float()
    towards = torch.randn(9, count, size)

    def run(gru: ResetGru, dtype: torch.dtype) -> list[Tensor]:
        given = [inputs.to(dtype, copy=True).requires_grad_(), hidden.to(dtype, copy=True).requires_grad_()]
        outputs, last = gru(*given, starts)
        assert torch.equal(outputs[-1], last)
        gradients = torch.autograd.grad((outputs * towards).sum(), [*given, *gru.parameters()])
        return [outputs.detach().double(), *(gradient.double() for gradient in gradients)]

    assert starts.any()
    for ours, torchs in zip(run(compiled, torch.float32), run(exact, torch.float64), strict=True):
        torch.testing.assert_close(ours, torchs, atol=1e-5, rtol=1e-5)


def test_acting_equals_the_first_step_of_a_sequence() -> None:
    torch.manual_seed(0)
    gru, inputs, hidden = ResetGru(6, 8), torch.randn(1, 3, 6), torch.randn(3, 8)
    starts = torch.tensor([[0.0, 1.0, 0.0]])
    with torch.no_grad():
        acting = gru(inputs, hidden, starts)
    for one, other in zip(acting, gru(inputs, hidden, starts), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_not_hidden(wrong: float) -> None:
    torch.manual_seed(0)
    gru, inputs = ResetGru(6, 8), torch.randn(4, 2, 6)
    inputs[1, 0, 0] = wrong
    outputs, _ = gru(inputs, torch.full((2, 8), 0.5), torch.zeros(4, 2))
    assert outputs[0].isfinite().all() and outputs[:, 1].isfinite().all()
    assert (outputs[1:, 0].isfinite().all()) == (wrong == float("inf"))  # a gate that is closed is finite, as in torch
    hidden = torch.full((2, 8), wrong)
    outputs, _ = gru(torch.randn(4, 2, 6), hidden, torch.zeros(4, 2))
    assert not outputs.isfinite().any()


def test_bfloat16_is_close(gru: ResetGru) -> None:
    inputs, hidden, starts = (tensor.detach().float() for tensor in data())
    gru = gru.float()

    def gradients(enabled: bool) -> tuple[Tensor, ...]:
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            outputs, _ = gru(inputs, hidden, starts)
        assert outputs.dtype == torch.float32
        return (outputs.detach(), *torch.autograd.grad(outputs.square().sum(), list(gru.parameters())))

    for exact, rounded in zip(gradients(False), gradients(True), strict=True):
        assert (exact - rounded).norm() < 0.03 * exact.norm()
        assert not torch.equal(exact, rounded)
