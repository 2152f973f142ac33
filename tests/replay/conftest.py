"""The street's network, written once."""

from pathlib import Path

import pytest

from tests.replay.recordings import write_street


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"))
