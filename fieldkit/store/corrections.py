"""What takes the place of what a recording states of its camera: read from files, applied where bags become frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from fieldkit.cameras import Camera
from fieldkit.store.files import digest
from fieldkit.store.inputs import Hand, read_camera, read_hand
from fieldkit.types import Applied


@dataclasses.dataclass(frozen=True)
class Corrections:
    """The arm camera, and its place in the hand with the latency of its stamps; None leaves what recordings state.

    ``applied`` are the files they were read from: errors name them, runs keep them.
    """

    camera: Camera | None = None
    hand: Hand | None = None
    applied: tuple[Applied, ...] = ()

    @property
    def late_ns(self) -> int:
        """By how much the images' stamps are late; 0 where nothing says so."""
        return 0 if self.hand is None or self.hand.latency is None else round(1e9 * self.hand.latency[0])

    def name(self, kind: Literal["camera", "hand"]) -> str:
        """Return the file of a correction, as errors name it."""
        return next((a.path for a in self.applied if a.kind == kind), f"the given {kind}")


def read_corrections(*, camera: Path | None = None, hand: Path | None = None) -> Corrections:
    """Read camera.toml and hand.toml, as far as they are given; raises StoreError for what is wrong with them."""
    files: list[tuple[Literal["camera", "hand"], Path | None]] = [("camera", camera), ("hand", hand)]
    return Corrections(
        None if camera is None else read_camera(camera),
        None if hand is None else read_hand(hand),
        tuple(Applied(kind, str(path), digest(Path(path))) for kind, path in files if path is not None),
    )
