"""Cameras and points from images: pairs, structure from motion, known poses, and images in the wrong place."""
