"""AprilTags: draw them, find them in images, solve their pose, and fuse what several images saw."""

from fieldkit.tags.detect import FAMILIES, TagDetection, detect
from fieldkit.tags.drawing import draw_tag
from fieldkit.tags.pose import TagSolution, solve, tag_corners

__all__ = ["FAMILIES", "TagDetection", "TagSolution", "detect", "draw_tag", "solve", "tag_corners"]
