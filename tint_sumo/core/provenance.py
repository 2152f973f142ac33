"""Where a run comes from: the command that began it, with its configuration, and the code that it ran."""

import platform
import shlex
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
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
    config: Callable[[], str]  # gives the configuration file that says the same

    def provenance(self, *, with_versions: bool) -> dict[str, Any]:
        """What JSON can hold of it, and of the code; without credentials."""
        told = {"command": redact(shlex.join(["tint-sumo", *self.words])), "commit": commit()}
        return {**told, "versions": versions(PACKAGES)} if with_versions else told


_ORIGIN: ContextVar[Origin | None] = ContextVar("origin", default=None)


@contextmanager
def made_by(origin: Origin | None) -> Iterator[None]:
    """What is made in the block comes from this command; None: from no command, or from one that is noted already."""
    token = _ORIGIN.set(origin)
    try:
        yield
    finally:
        _ORIGIN.reset(token)


def present_origin() -> Origin | None:
    return _ORIGIN.get()


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of installed packages, and of Python."""
    return {name: version(name) for name in packages} | {"python": platform.python_version()}


def version_text() -> str:
    """Return the version of this package, and those of what it stands on in a second line."""
    shown = {"SUMO": "libsumo", "torch": "torch", "gymnasium": "gymnasium", "Python": "python"}
    found = versions(("tint_sumo", "libsumo", "torch", "gymnasium"))
    return f"tint-sumo {found['tint_sumo']}\n" + ", ".join(f"{name} {found[key]}" for name, key in shown.items())


@cache
def commit(checkout: Path = _CHECKOUT) -> str | None:
    """The git commit of a checkout, with ``-dirty`` if files differ from it; None where there is no checkout."""
    if not (checkout / ".git").exists():  # an installed package may lie in the checkout of something else
        return None
    describe = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
