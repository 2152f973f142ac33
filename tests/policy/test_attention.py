import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tint_sumo.policy.attention import AllSlots, Layers, Packing, attend, linear_layers
from tint_sumo.traits.encoder import perceptron

STREETS, SLOTS, FEATURES = 9, 5, 4


@pytest.fixture
def mask() -> Tensor:
    """Streets with vehicles in any slots; the first has none, the last is full."""
    mask = (torch.rand(STREETS, SLOTS, generator=torch.Generator().manual_seed(0)) < 0.5).double()
    mask[0], mask[-1] = 0.0, 1.0
    return mask


@pytest.fixture
def vehicles() -> Tensor:
    return torch.randn(STREETS, SLOTS, FEATURES, generator=torch.Generator().manual_seed(1), dtype=torch.double)


def networks(score_sizes: tuple[int, ...]) -> tuple[nn.Sequential, nn.Sequential]:
    """Embedding of 3 and its score; without sizes, the score has no layers."""
    torch.manual_seed(0)
    score = (
        nn.Sequential(*perceptron(6, *score_sizes), nn.Linear(score_sizes[-1], 1)) if score_sizes else nn.Sequential()
    )
    return perceptron(FEATURES, 6, 3).double(), score.double()


def plain(mask: Tensor, vehicles: Tensor, embed: nn.Sequential, score: nn.Sequential) -> tuple[Tensor, Tensor]:
    """Street by street, vehicle by vehicle, with the derivative that autograd finds."""
    sums, weights = [], torch.zeros_like(mask)
    for street, real in enumerate(mask > 0.5):
        e = embed(vehicles[street, real])
        count = len(e)
        both = torch.cat([e, e.mean(0).expand_as(e)], dim=1)
        alpha = (
            torch.softmax(score(both), dim=0) if len(score) else torch.full((count, 1), 1.0 / max(count, 1)).double()
        )
        weights[street, real] = alpha.detach()[:, 0]
        sums.append((alpha * e).sum(0))
    return torch.stack(sums), weights


@pytest.mark.parametrize("score_sizes", [(8,), (8, 7), (8, 9, 7), ()])
def test_equals_the_plain_formula_with_its_gradients(
    mask: Tensor, vehicles: Tensor, score_sizes: tuple[int, ...]
) -> None:
    embed, score = networks(score_sizes)
    parameters = [*embed.parameters(), *score.parameters()]
    inputs = vehicles.requires_grad_()
    packing = Packing.of(mask)
    found = attend(packing, packing.pack(inputs), linear_layers(embed), linear_layers(score))
    expected = plain(mask, inputs, embed, score)
    towards = torch.randn(STREETS, 3, generator=torch.Generator().manual_seed(2), dtype=torch.double)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    gradients = [torch.autograd.grad((sums * towards).sum(), [inputs, *parameters]) for sums, _ in (found, expected)]
    for ours, autograds in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, autograds)
    assert all(gradient.any() for gradient in gradients[0][:-1])  # a bias of all scores changes no weight


def test_streets_without_any_vehicle() -> None:
    embed, score = networks((4,))
    packing = Packing.of(torch.zeros(STREETS, SLOTS).double())
    layers: tuple[Layers, Layers] = (linear_layers(embed), linear_layers(score))
    sums, weights = attend(packing, packing.pack(torch.zeros(STREETS, SLOTS, FEATURES).double()), *layers)
    sums.sum().backward()  # type: ignore[no-untyped-call]
    assert not sums.any() and not weights.any()
    assert not any(parameter.grad.any() for parameter in embed.parameters() if parameter.grad is not None)


def test_padding_has_no_influence(mask: Tensor, vehicles: Tensor) -> None:
    embed, score = networks((4,))
    layers = (linear_layers(embed), linear_layers(score))
    padded = Packing.of(mask)
    with torch.no_grad():
        tight = Packing.of(mask)
    assert len(tight.rows) == int(mask.sum()) < len(padded.rows)
    for one, other in zip(*(attend(one, one.pack(vehicles), *layers) for one in (padded, tight)), strict=True):
        torch.testing.assert_close(one, other)
    values = functional.pad(torch.ones(len(tight.rows), 2), (0, 0, 0, len(padded.rows) - len(tight.rows)), value=7.0)
    torch.testing.assert_close(padded.sums(values), mask.sum(1, keepdim=True).expand(-1, 2).float())


@pytest.mark.parametrize("score_sizes", [(8,), (8, 9, 7), ()])
def test_all_slots_as_rows_give_the_same_whatever_is_in_empty_ones(
    mask: Tensor, vehicles: Tensor, score_sizes: tuple[int, ...]
) -> None:
    embed, score = networks(score_sizes)
    layers = linear_layers(embed), linear_layers(score)
    packing, slots = Packing.of(mask), AllSlots.of(mask)
    garbage = torch.where(mask.unsqueeze(-1) > 0.5, vehicles, torch.nan)
    expected = attend(packing, packing.pack(vehicles), *layers)
    for one, other in zip(attend(slots, slots.pack(garbage), *layers), expected, strict=True):
        torch.testing.assert_close(one, other)
