"""Maps of roads as SUMO networks: OpenDRIVE, OpenStreetMap, and lanelets. Each format of lanelets is one module."""

from tint_sumo.maps.importing import FORMATS, ImportedMap, find_format, import_map

__all__ = ["FORMATS", "ImportedMap", "find_format", "import_map"]
