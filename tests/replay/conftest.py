"""Networks, written once."""

from pathlib import Path

import pytest

from tests.replay.recordings import write_street
from tests.scenes.networks import netconvert


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def pavements(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A junction with pavements: two lanes come from the west, the left one of which alone leads to the north."""
    nodes = (
        '<node id="a" x="0" y="0"/><node id="b" x="80" y="0"/><node id="c" x="160" y="0"/><node id="d" x="80" y="80"/>'
    )
    edges = "".join(
        f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="2" sidewalkWidth="2"/>'
        for name in ("ab", "bc", "bd")
    )
    return netconvert(tmp_path_factory.mktemp("pavements"), nodes, edges, "pavements")
