"""Build hook: put tint_sumo.pth beside the installed package, in wheels and in editable installs."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PthHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        pth = str(Path(self.root) / "scripts" / "tint_sumo.pth")
        key = "force_include_editable" if version == "editable" else "force_include"
        build_data[key][pth] = "tint_sumo.pth"
