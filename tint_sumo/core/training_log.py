"""TensorBoard logs in the folders of trainings: curves, hyperparameters and films."""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image
from stable_baselines3.common.logger import HParam, Logger, TensorBoardOutputFormat, configure
from tensorboard.compat.proto.summary_pb2 import Summary

from tint_sumo.core.redaction import redact

FOLDER = "tensorboard"
_HYPERPARAMETERS = "hyperparameters"


def open_log(out: Path, hyperparameters: Mapping[str, Any], results: Sequence[str], step: int = 0) -> Logger:
    """Open the log of the training in ``out``, an existing log at its end.

    Args:
        out: the training's folder; the log goes into ``tensorboard`` there.
        hyperparameters: settings of the training; nested ones get names with dots.
        results: names of the curves whose last values stand beside them.
        step: the last step of an earlier call.
    """
    logger = configure(str(out / FOLDER), ["tensorboard"])
    logger.record(_HYPERPARAMETERS, HParam(dict(_flat(hyperparameters, "")), dict.fromkeys(results, 0.0)))
    logger.dump(step)
    return logger


def _flat(settings: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield names and values of nested settings, as TensorBoard takes them."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value if isinstance(value, bool | int | float) else redact(str(value))


def log_film(logger: Logger, name: str, gif: bytes, step: int) -> None:
    """Log a film, which TensorBoard plays among its images; a video would need moviepy."""
    with Image.open(io.BytesIO(gif)) as first:
        image = Summary.Image(width=first.width, height=first.height, colorspace=3, encoded_image_string=gif)
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            writer: Any = output.writer
            writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)
            writer.flush()
