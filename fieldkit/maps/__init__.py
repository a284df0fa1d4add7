"""Maps: structure from motion, metric alignment, landmarks and surface, from images to a map folder and back."""

from fieldkit.maps.appearance import appearance_path, known_appearances
from fieldkit.maps.appearing import add_appearance
from fieldkit.maps.build import MapReport, build_map
from fieldkit.maps.compact import compact_map
from fieldkit.maps.exchange.exporting import Exported, export_map
from fieldkit.maps.exchange.import_frame import FrameOptions
from fieldkit.maps.exchange.importing import ImportOptions, import_map
from fieldkit.maps.exchange.meshes import ForeignMesh
from fieldkit.maps.gauge import Gauge, fit_gauge
from fieldkit.maps.io import changed, content_digest, load_map, map_info
from fieldkit.maps.landmarks import LandmarkRules
from fieldkit.maps.options import MapOptions
from fieldkit.warp import MapWarp, map_warp

__all__ = [
    "Exported",
    "ForeignMesh",
    "FrameOptions",
    "Gauge",
    "ImportOptions",
    "LandmarkRules",
    "MapOptions",
    "MapReport",
    "MapWarp",
    "add_appearance",
    "appearance_path",
    "build_map",
    "changed",
    "compact_map",
    "content_digest",
    "export_map",
    "fit_gauge",
    "import_map",
    "known_appearances",
    "load_map",
    "map_info",
    "map_warp",
]
