from tests.dataset.test_recorder import dataset

__all__ = ["dataset"]
