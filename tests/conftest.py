"""Shared by all tests."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Tests run in parallel; torch's own threads would only get in each other's way."""
    torch.set_num_threads(1)
