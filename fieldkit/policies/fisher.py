"""The Fisher information policy (Zhang and Scaramuzza, Fisher Information Field)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldkit.policies.scene import Scene

Array = NDArray[np.float64]


def fisher_information(scene: Scene) -> Array:
    """Sum over the visible landmarks the trace of each one's 6x6 information on the camera pose; f64[v].

    A bearing f = x / |x| with 1 px noise (sigma = 1 / focal length, rad) has the Jacobian
    (I - f f^T) / |x| [[x]_x, -I] for a right perturbation, rotation (rad) before translation (m). The rotation block
    contributes 2, the translation block 2 / |x|^2: the trace is (2 + 2 / |x|^2) / sigma^2.
    """
    focal_px = float(np.mean(scene.candidates.camera.focal_px))
    information = [
        float(np.sum(2.0 + 2.0 / np.maximum(np.sum(x**2, axis=1), 1e-6))) * focal_px**2 for x in scene.visible.x_in_cam
    ]
    return np.where(scene.candidates.allowed, information, -np.inf)
