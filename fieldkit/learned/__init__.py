"""Learned scores of views: networks, their checkpoints, and scoring with them. Torch is imported only where it runs."""
