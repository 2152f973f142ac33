"""Recorded tracks of real or simulated traffic in one table, whatever their format. Each format is one module."""

from tint_sumo.tracks import commonroad as commonroad
from tint_sumo.tracks import fcd as fcd
from tint_sumo.tracks import interaction as interaction
from tint_sumo.tracks import leader_follower as leader_follower
from tint_sumo.tracks import levelx as levelx
from tint_sumo.tracks import ngsim as ngsim
from tint_sumo.tracks.matching import Matched, match
from tint_sumo.tracks.reading import FORMATS, TrackFormat, read_tracks, register
from tint_sumo.tracks.schema import TRACK_SCHEMA, Tracks

__all__ = ["FORMATS", "TRACK_SCHEMA", "Matched", "TrackFormat", "Tracks", "match", "read_tracks", "register"]
