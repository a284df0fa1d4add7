"""Maps: structure from motion, metric alignment, landmarks and surface, from images to a map folder and back."""

from fieldkit.maps.build import MapOptions, MapReport, build_map
from fieldkit.maps.compact import compact_map
from fieldkit.maps.io import content_digest, load_map, map_info

__all__ = ["MapOptions", "MapReport", "build_map", "compact_map", "content_digest", "load_map", "map_info"]
