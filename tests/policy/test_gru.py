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
