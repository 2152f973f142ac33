import pytest
import torch

from tint_sumo.core.fast_torch import keep_freed_memory, wide_products


def test_products_stay_float32() -> None:
    """Next to products of doubles, they are wrong by float32's rounding."""
    random = torch.Generator().manual_seed(0)
    one, other = torch.randn(300, 150, generator=random), torch.randn(150, 100, generator=random)
    exact = one.double() @ other.double()
    with wide_products():
        assert float(((one @ other) - exact).abs().max()) < 1e-4


def test_the_setting_is_as_before_after_a_block() -> None:
    before = torch.get_float32_matmul_precision()
    with pytest.raises(ZeroDivisionError), wide_products():
        raise ZeroDivisionError
    assert torch.get_float32_matmul_precision() == before
    with wide_products(wanted=False):
        assert torch.get_float32_matmul_precision() == before


def test_freed_memory_is_kept() -> None:
    """Arrays of some megabytes cost no page faults once their memory has been used."""
    resource = pytest.importorskip("resource")
    keep_freed_memory()

    def faults() -> int:
        before: int = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        torch.ones(2_000_000)
        return int(resource.getrusage(resource.RUSAGE_SELF).ru_minflt) - before

    faults()
    assert min(faults() for _ in range(5)) < 100
