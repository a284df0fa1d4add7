"""Maps: structure from motion, metric alignment, landmarks and surface, from images to a map folder and back."""

from fieldkit.maps.build import build_map
from fieldkit.maps.compact import compact_map
from fieldkit.maps.gauge import Gauge, fit_gauge
from fieldkit.maps.io import content_digest, load_map, map_info
from fieldkit.maps.options import MapOptions, MapReport
from fieldkit.maps.warp import MapWarp, map_warp

__all__ = [
    "Gauge",
    "MapOptions",
    "MapReport",
    "MapWarp",
    "build_map",
    "compact_map",
    "content_digest",
    "fit_gauge",
    "load_map",
    "map_info",
    "map_warp",
]
