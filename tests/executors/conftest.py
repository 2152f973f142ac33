from tests.dataset.test_recorder import two_shards
from tests.study.conftest import brief, tiny

__all__ = ["brief", "tiny", "two_shards"]
