"""AprilTags: draw them, find them in images, solve their pose, and fuse what several images saw."""

from fieldkit.tags.detect import TagDetection, detect
from fieldkit.tags.detectors import DETECTORS, FoundTag, TagDetector
from fieldkit.tags.drawing import draw_tag
from fieldkit.tags.families import FAMILIES
from fieldkit.tags.fusion import Sighting, TagFix, fuse_sightings
from fieldkit.tags.pose import TagSolution, solve, tag_corners
from fieldkit.tags.sightings import ARM_COVARIANCE, BodySightings, body_in_map, body_sightings, fuse_body_sightings

__all__ = [
    "ARM_COVARIANCE",
    "DETECTORS",
    "FAMILIES",
    "BodySightings",
    "FoundTag",
    "Sighting",
    "TagDetection",
    "TagDetector",
    "TagFix",
    "TagSolution",
    "body_in_map",
    "body_sightings",
    "detect",
    "draw_tag",
    "fuse_body_sightings",
    "fuse_sightings",
    "solve",
    "tag_corners",
]
