"""Driving among strangers: driver-trait inference and intersection navigation on Eclipse SUMO.

Importing this package stays cheap: ``tint_sumo.pth`` does it whenever Python starts, so that gymnasium knows the
environments with no import but its own (gymnasium 1.0 gave up its plugin entry points).
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

__version__ = "0.1.0"

ENV_ID = "tint_sumo/TIntersection-v1"


def register_envs() -> None:
    """Register the environments with gymnasium."""
    from gymnasium.envs.registration import register, registry  # noqa: PLC0415 - keeps the package's import cheap

    if ENV_ID not in registry:
        register(
            id=ENV_ID,
            entry_point="tint_sumo.envs.t_intersection:TIntersectionEnv",
            vector_entry_point="tint_sumo.envs.vector:TIntersectionVectorEnv",
        )


class _RegisterAfterGymnasium(MetaPathFinder):
    """Import hook that registers the environments as soon as gymnasium has been imported, and then is gone."""

    def find_spec(
        self, fullname: str, path: "Sequence[str] | None", target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.loader is None:
            return None
        run_gymnasium = spec.loader.exec_module

        def run_and_register(module: ModuleType) -> None:
            run_gymnasium(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            register_envs()

        spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium" in sys.modules:
    register_envs()
else:
    sys.meta_path.insert(0, _RegisterAfterGymnasium())
