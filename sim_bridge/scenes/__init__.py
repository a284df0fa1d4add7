"""The scenes by name; a further scene is a builder and one line here."""

from collections.abc import Callable

from sim_bridge.mesh import Scene
from sim_bridge.scenes.room import furnished_room

__all__ = ["SCENES", "Scene"]

# Name -> builder of the scene from a seed.
SCENES: dict[str, Callable[[int], Scene]] = {"room": furnished_room}
