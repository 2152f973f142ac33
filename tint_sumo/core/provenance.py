"""Origin of a run: the command that began it, with its configuration, and the version of the code."""

import platform
import shlex
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tint_sumo.core.redaction import redact

PROVENANCE_FILE = "provenance.json"
CONFIG_FILE = "config.yaml"
_CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = (  # whose versions may change a result
    "tint_sumo",
    "libsumo",
    "torch",
    "stable-baselines3",
    "gymnasium",
    "numpy",
    "pandas",
    "pyarrow",
    "scikit-learn",
)


@dataclass(frozen=True)
class Origin:
    """The command that this process is running."""

    words: tuple[str, ...]  # words of its command line
    config: Callable[[], str]  # returns a configuration file with the same settings

    def provenance(self, *, with_versions: bool) -> dict[str, Any]:
        """Return the command and the version of the code for a JSON file, without credentials."""
        found = {"command": redact(shlex.join(["tint-sumo", *self.words])), "commit": commit()}
        return {**found, "versions": versions(PACKAGES)} if with_versions else found


_ORIGIN: ContextVar[Origin | None] = ContextVar("origin", default=None)


@contextmanager
def made_by(origin: Origin | None) -> Iterator[None]:
    """Note this command as the origin of the block's runs; None: they have no command, or it is noted already."""
    token = _ORIGIN.set(origin)
    try:
        yield
    finally:
        _ORIGIN.reset(token)


def present_origin() -> Origin | None:
    return _ORIGIN.get()


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Return the versions of installed packages, and of Python."""
    return {name: version(name) for name in packages} | {"python": platform.python_version()}


def version_text() -> str:
    """Return the version of this package and, in a second line, those of the main packages that it uses."""
    shown = {"SUMO": "libsumo", "torch": "torch", "gymnasium": "gymnasium", "Python": "python"}
    found = versions(("tint_sumo", "libsumo", "torch", "gymnasium"))
    return f"tint-sumo {found['tint_sumo']}\n" + ", ".join(f"{name} {found[key]}" for name, key in shown.items())


@lru_cache(maxsize=1)
def commit(checkout: Path = _CHECKOUT) -> str | None:
    """Return the git commit of a checkout, with ``-dirty`` if files differ from it; None if it is no checkout."""
    if not (checkout / ".git").exists():  # an installed package may lie in the checkout of something else
        return None
    describe = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
