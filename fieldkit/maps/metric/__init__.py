"""Metric scale, gravity and frame: from SLAM positions, tags of known size, depth images, or what the images show."""
