"""What the networks share: images as tensors, keypoints in a repeatable order, one run at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldkit.types import Image

if TYPE_CHECKING:
    import torch

Floats = NDArray[np.float32]
# Networks look at neighbourhoods; in a smaller image there is none.
MIN_SIDE_PX = 32


def as_tensor(image: Image) -> torch.Tensor:
    """Return uint8[h, w] or [h, w, 3] as f32[1, channels, h, w] in 0..1."""
    import torch

    planes = image[None] if image.ndim == 2 else image.transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(planes)).float().div_(255.0)[None]


def strongest(scores: Floats, positions: Floats, count: int) -> NDArray[np.int64]:
    """Return the indices of the highest scores, in order; equal scores are ordered by position [n, 2]."""
    return np.asarray(np.lexsort((positions[:, 1], positions[:, 0], -scores))[:count], dtype=np.int64)


def no_keypoints(width: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return what a detector returns for an image without keypoints."""
    empty = np.zeros(0, dtype=np.float32)
    return np.zeros((0, 2), dtype=np.float32), empty, empty, np.zeros((0, width), dtype=np.float32)


def one_at_a_time(run: Callable[..., Any]) -> Callable[..., Any]:
    """Let one thread at a time into ``run``, in torch's inference mode: torch itself uses all processors."""
    import torch

    lock = threading.Lock()

    def guarded(*values: Any) -> Any:
        with lock, torch.inference_mode():
            return run(*values)

    return guarded
