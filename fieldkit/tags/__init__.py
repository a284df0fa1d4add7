"""AprilTags: draw them, find them in images, and solve their pose."""

from fieldkit.tags.drawing import draw_tag

__all__ = ["draw_tag"]
