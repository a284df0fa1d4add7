"""AprilTags: draw them, find them in images, solve their pose, and fuse what several images saw."""

from fieldkit.tags.detect import TagDetection, detect
from fieldkit.tags.detectors import DETECTORS, FoundTag, TagDetector
from fieldkit.tags.drawing import draw_tag
from fieldkit.tags.families import FAMILIES, check_families
from fieldkit.tags.fusion import Sighting, TagFix, fuse_sightings
from fieldkit.tags.joint import image_covariance
from fieldkit.tags.pose import TagSolution, solve, tag_corners
from fieldkit.tags.sightings import (
    BodySighting,
    BodySightings,
    Place,
    body_sightings,
    frames_between,
    placed_tags,
    tags_in,
    with_noise,
)
from fieldkit.tags.standing import BodyFix, body_in_map, hand_covariance, locate_body

__all__ = [
    "DETECTORS",
    "FAMILIES",
    "BodyFix",
    "BodySighting",
    "BodySightings",
    "FoundTag",
    "Place",
    "Sighting",
    "TagDetection",
    "TagDetector",
    "TagFix",
    "TagSolution",
    "body_in_map",
    "body_sightings",
    "check_families",
    "detect",
    "draw_tag",
    "frames_between",
    "fuse_sightings",
    "hand_covariance",
    "image_covariance",
    "locate_body",
    "placed_tags",
    "solve",
    "tag_corners",
    "tags_in",
    "with_noise",
]
