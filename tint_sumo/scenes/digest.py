"""The digest of a scene's roads and task: a hash of listed values, by which scenes differ.

Policies and trait models carry the digest of the scene that they were trained in, and are refused where it differs.
So fields are listed by their names: a new one that has a default leaves the digests of all scenes as they are.
"""

import hashlib
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import fields
from numbers import Real
from typing import Any, get_args

# Version 1. The values listed here, in this order, make the text that is hashed: a change gives all scenes another
# digest, so that what was trained before is refused. Drivers, their mix and the time limit do not count.
_LISTED: Mapping[str, tuple[str, ...]] = {
    "Scene": ("network", "routes", "ego", "vehicle", "claim", "step_s", "max_vehicles"),
    "Network": ("nodes", "edges", "connections", "left_hand", "lane_width_m", "speed_limit_mps"),
    "Node": ("id", "x_m", "y_m", "shape", "type"),
    "Edge": ("id", "start", "end", "priority", "shape"),
    "Connection": ("start", "end", "shape"),
    "Route": ("name", "edges"),
    "EgoTask": ("edges", "start_m", "goal_m", "way", "controller"),
    "EgoController": (
        "desired_speeds_mps",
        "gain_per_s",
        "accel_limit_mps2",
        "unsafe_distance_m",
        "closing_distance_m",
        "closing_speed_mps",
        "watches_behind",
        "braking_gain_per_s",
        "braking_limit_mps2",
    ),
    "VehicleShape": ("length_m", "width_m"),
    "Claim": (
        "by",
        "approach_speed_mps",
        "path_margin_m",
        "courtesy_gap_m",
        "reaction_time_s",
        "braking_mps2",
    ),
}
Route = namedtuple("Route", ["name", "edges"])  # version 1 writes routes by their name, and other parts as mappings


def scene_digest(scene: Any) -> str:
    """Return the digest of a ``tint_sumo.scenes.Scene``: 16 hexadecimal digits."""
    text = repr(list(_values(scene, "Scene").values()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    """Return a value as it is written; numbers that are no counts are floats, so that 1 and 1.0 are the same."""
    if isinstance(value, tuple | list):
        return tuple(map(_plain, value))
    if isinstance(value, Real) and not isinstance(value, bool):
        return float(value)
    kind = next((base.__name__ for base in type(value).__mro__ if base.__name__ in _LISTED), None)
    if kind is None:
        return value
    values = _values(value, kind)
    return Route(**values) if kind == "Route" else values


def _values(owner: Any, kind: str) -> dict[str, Any]:
    """Return the listed values of a dataclass by their names."""
    counts = {field.name for field in fields(owner) if (get_args(field.type) or [field.type])[0] is int}
    values = {name: getattr(owner, name) for name in _LISTED[kind]}
    return {name: int(value) if name in counts else _plain(value) for name, value in values.items()}
