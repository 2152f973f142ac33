"""Shared by all tests."""

import os

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Tests run in parallel; torch's own threads would only get in each other's way."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _logs_in_a_folder_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Stable-Baselines3 makes one for every training that is given none."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))
