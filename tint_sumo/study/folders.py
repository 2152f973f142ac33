"""Paths of a study's files, relative to its folder."""

DATASET = "dataset"
RESULTS = "results"  # a file for each result


def trait_folder(method: str) -> str:
    """Return the folder of a trait model that the study trains."""
    return f"traits/{method}"
