from tests.dataset.test_recorder import dataset, two_shards

__all__ = ["dataset", "two_shards"]
