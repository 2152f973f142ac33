from tests.dataset.test_recorder import two_shards

__all__ = ["two_shards"]
