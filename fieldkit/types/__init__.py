"""The nouns that the rooms hand to each other: frozen, without I/O."""

from fieldkit.frames import Array
from fieldkit.types.maps import LandmarkStatistics, SceneMap, Surface
from fieldkit.types.recordings import (
    VIEW_KINDS,
    Frame,
    Image,
    OdometryFault,
    Recording,
    SeenTag,
    Start,
    View,
    ViewKind,
    Visit,
)
from fieldkit.types.results import (
    Applied,
    Candidates,
    Estimate,
    Excluded,
    PlanView,
    Prior,
    Run,
    Trial,
    Truth,
    ViewResult,
    VisitPlan,
)
from fieldkit.types.tags import TAG_BOUNDS, TagBounds, TagMap, TagPhoto, TagPose

__all__ = [
    "TAG_BOUNDS",
    "VIEW_KINDS",
    "Applied",
    "Array",
    "Candidates",
    "Estimate",
    "Excluded",
    "Frame",
    "Image",
    "LandmarkStatistics",
    "OdometryFault",
    "PlanView",
    "Prior",
    "Recording",
    "Run",
    "SceneMap",
    "SeenTag",
    "Start",
    "Surface",
    "TagBounds",
    "TagMap",
    "TagPhoto",
    "TagPose",
    "Trial",
    "Truth",
    "View",
    "ViewKind",
    "ViewResult",
    "Visit",
    "VisitPlan",
]
