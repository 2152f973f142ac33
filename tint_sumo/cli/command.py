"""Base classes of commands. A command is a dataclass whose fields are its flags."""

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from tint_sumo.cli.values import optional
from tint_sumo.core.errors import InputError
from tint_sumo.core.stores import name_in

if TYPE_CHECKING:
    from tint_sumo.jobs import Workers


RESUMES = ", the same command goes on from here"
_CONFIG = optional(
    "FILE",
    "YAML file with values of these flags, named as here but with underscores; flags that are given here win. A scene, "
    "a budget or a population can be a mapping there of its base and the numbers that differ.",
)
_ADDRESS = arg(
    help="Address of the Ray cluster: ray://HOST:10001; local for Ray on this machine alone; or auto for the cluster "
    "that RAY_ADDRESS names or that runs on this machine or, if there is none, local."
)


@dataclass(frozen=True)
class Outcome:
    """Result of a command: lines for people and, with --json, one object."""

    text: str
    content: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Command:
    """Base class of commands."""

    after_interrupt: ClassVar[str] = ", nothing was kept"

    json: bool = False
    """Print the result as one JSON object, too, in the last line of stdout."""
    config: Annotated[Path | None, _CONFIG] = None
    print_config: bool = False
    """Print all values as such a file, and do nothing else."""

    def run(self) -> Outcome:
        raise NotImplementedError

    def with_flags(self, message: str) -> str:
        """Show the flags of this command in an error's message, which has arguments between backticks."""
        names = "|".join(field.name for field in fields(self))
        return re.sub(f"`({names})`", lambda found: flag_of(found[1]), message)


@dataclass(frozen=True, kw_only=True)
class SpreadCommand(Command):
    """Base class of commands whose work many machines can share."""

    executor: Literal["local", "ray"] = "local"
    """local: this machine. ray: a Ray cluster, with the same results; needs tint_sumo[ray]."""
    address: Annotated[str, _ADDRESS] = "auto"

    @contextmanager
    def workers_of(self, workers: int, gpus_per_job: float = 0.0) -> "Iterator[Workers]":
        """Give, in the block, what does the work: the number of processes, or the cluster."""
        if self.executor == "local":
            for name, value, default in (("address", self.address, "auto"), ("gpus_per_job", gpus_per_job, 0.0)):
                if value != default:
                    raise InputError(f"{flag_of(name)} goes with --executor ray; add that, or leave it out")
            yield workers
            return
        if workers != getattr(type(self), "workers", workers):  # a command without that flag uses no processes
            raise InputError("--workers goes with --executor local; a cluster does as many jobs as it has room for")
        try:
            from tint_sumo.jobs.cluster import ray_cluster
        except ModuleNotFoundError as error:
            if error.name != "ray":
                raise
            raise InputError('--executor ray needs Ray; install it: pip install "tint_sumo[ray]"') from None
        with ray_cluster(self.address, gpus_per_job) as found:
            if found.dashboard_url:
                print(f"Ray's dashboard: http://{found.dashboard_url}", file=sys.stderr)
            yield found


def flag_of(name: str) -> str:
    """Return the flag of a field of a command."""
    return "--" + name.replace("_", "-")


def names_in(out: str, folder: Path, files: Iterable[Path | None]) -> list[str]:
    """Return the names that the user knows of files in a folder that stands for the output folder ``out``."""
    return [name_in(out, file.relative_to(folder)) for file in files if file is not None]


def wrote(files: Iterable[str]) -> Iterator[str]:
    """Return a line for each file that was written."""
    return (f"wrote {file}" for file in files)


def use_one_thread() -> None:
    """Let torch use one thread: with small networks more gain little, and cost much if other work needs the cores."""
    import torch

    torch.set_num_threads(1)


@contextmanager
def exporting_onnx() -> Iterator[None]:
    """Say, in the block, which extra to install where a package for ONNX is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in ("onnx", "onnxscript"):
            raise
        raise InputError('--onnx needs onnx and onnxscript; install them: pip install "tint_sumo[onnx]"') from None
