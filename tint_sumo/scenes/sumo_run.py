"""Runs of a SUMO configuration that leave all files of its user as they are."""

import shutil
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import lru_cache
from itertools import chain
from pathlib import Path

import numpy as np

from tint_sumo.scenes.sumo_config import SumoConfig, first_reason, refused

_SEED_BITS = 31
_ADDITIONAL = "additional-files"
_UP = "../" * 64  # from any folder to the root
_CONTROLLED = {
    "random": "false",
    "collision.action": "none",  # the ego's are found here, and others' change nothing
    "no-step-log": "true",
    "no-warnings": "true",
    "verbose": "false",
    "duration-log.disable": "true",
}
_LOAD = """
import sys, libsumo
try:
    libsumo.start(["sumo", *sys.argv[1:]])
except Exception as error:
    sys.exit(f"Error: {error}")
libsumo.close()
"""


class SumocfgRun:
    """Command-line options of runs of a configuration.

    The configuration's output options are left out. Files that its additional files and devices write, wherever, go to
    a temporary folder: SUMO puts ``output-prefix`` before the last part of each path. ``close`` removes that folder,
    with all that has been put into it.

    Args:
        config: the configuration.
        types_xml: vTypes that are added to those of the configuration.
    """

    def __init__(self, config: SumoConfig, types_xml: str = "") -> None:
        folder = Path(tempfile.mkdtemp(prefix="tint_sumo_"))
        self.close = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.output = folder / "output"
        self.output.mkdir()
        prefix = {"output-prefix": f"{_UP}{self.output.resolve().relative_to('/')}/"}
        self._values = config.values(folder) | _CONTROLLED | prefix
        if types_xml:
            types = folder / "types.add.xml"
            types.write_text(f"<additional>{types_xml}</additional>", encoding="utf-8")
            files = [named for named in (self._values.get(_ADDITIONAL, ""), str(types)) if named]
            self._values[_ADDITIONAL] = ",".join(files)

    def options(
        self, seed: int | Sequence[int], step_s: float | None = None, more: Mapping[str, str | None] | None = None
    ) -> list[str]:
        """Return the options of a run.

        Args:
            seed: of SUMO's random numbers.
            step_s: step length; the configuration's if not given.
            more: further options, without their dashes; None leaves one of the configuration out.
        """
        draws = np.random.SeedSequence(seed).generate_state(1)
        values = self._values | {"seed": str(int(draws[0]) % 2**_SEED_BITS)}
        values |= {} if step_s is None else {"step-length": str(step_s)}
        given = {name: value for name, value in (values | dict(more or {})).items() if value is not None}
        return list(chain.from_iterable((f"--{name}", value) for name, value in given.items()))


def require_loads(config: SumoConfig) -> None:
    """Let a process of its own load a configuration: SUMO can crash at damaged files, and prints more than one line.

    Raises:
        InputError: SUMO does not load it, or crashes.
    """
    _require_loads(config, config.digest)


@lru_cache(maxsize=64)
def _require_loads(config: SumoConfig, _digest: str) -> None:
    with closing(SumocfgRun(config)) as run:
        reason = why_not_loaded(run.options(seed=0))
    if reason:
        raise refused(f"does not run {config.file} ({reason})", config.file)


def why_not_loaded(options: Sequence[str]) -> str:
    """Let SUMO load a run's input in a process of its own; return why it does not, "" if it does."""
    result = subprocess.run([sys.executable, "-c", _LOAD, *options], capture_output=True, text=True, check=False)
    if result.returncode == 0:
        return ""
    return first_reason(result.stderr) or f"it ends with code {result.returncode}"
