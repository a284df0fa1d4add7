"""The scenes by name; a further scene is a generator and one line here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldkit.errors import suggestion
from sim_bridge.errors import SynthesisError
from sim_bridge.mesh import Scene
from sim_bridge.scenes.blueprint import Blueprint
from sim_bridge.scenes.clinic import clinic
from sim_bridge.scenes.laboratory import laboratory
from sim_bridge.scenes.library import library
from sim_bridge.scenes.light import lit
from sim_bridge.scenes.lobby import lobby
from sim_bridge.scenes.museum import museum
from sim_bridge.scenes.office import office
from sim_bridge.scenes.room import furnished_room
from sim_bridge.scenes.school import school
from sim_bridge.scenes.shop import shop
from sim_bridge.scenes.workshop import workshop

__all__ = ["SCENES", "make_blueprint", "make_scene"]

# Name -> generator of the scene from a seed.
SCENES: dict[str, Callable[[int], Blueprint]] = {
    "room": furnished_room,
    "office": office,
    "lobby": lobby,
    "laboratory": laboratory,
    "workshop": workshop,
    "shop": shop,
    "library": library,
    "clinic": clinic,
    "school": school,
    "museum": museum,
}


def make_blueprint(name: str, seed: int) -> Blueprint:
    """Make the blueprint of a scene by name; raises SynthesisError for a name that does not exist."""
    if name not in SCENES:
        raise SynthesisError(f"unknown scene {name!r}", hint=suggestion(name, list(SCENES)))
    return SCENES[name](seed)


def make_scene(name: str, seed: int) -> Scene:
    """Make a scene by name, lit as when it is mapped; the same name and seed give the same scene."""
    return lit(make_blueprint(name, seed), rng=np.random.default_rng([seed, 90709]))
