"""Errors of SUMO while it runs a configuration."""

from dataclasses import dataclass

from tint_sumo.scenes.sumo_config import SumoConfig, refused
from tint_sumo.simulation.connection import SUMO_ERRORS


@dataclass(frozen=True)
class Refusals:
    """Raises InputError, one line, where SUMO finds fault with the configuration in a ``with`` block.

    A class, since a step of a few vehicles would notice the time that a generator takes.
    """

    config: SumoConfig

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, SUMO_ERRORS):
            raise refused(f"does not run {self.config.file} ({one_line(error)})", self.config.file) from None


def one_line(error: BaseException) -> str:
    """Return an error of SUMO, whose lines are joined."""
    return " ".join(str(error).split())
