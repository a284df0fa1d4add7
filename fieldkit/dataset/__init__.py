"""Datasets: the views of many scenes and waypoints, localized, as features and labels; made once, replayed often."""

from fieldkit.dataset.appearing import add_appearances, open_weights
from fieldkit.dataset.counting import SceneCount, count_scenes
from fieldkit.dataset.making import Progress, make_dataset
from fieldkit.dataset.replaying import replay_datasets
from fieldkit.dataset.source import SourceView, SourceWaypoint, ViewSource
from fieldkit.store.datasets import DatasetRules

__all__ = [
    "DatasetRules",
    "Progress",
    "SceneCount",
    "SourceView",
    "SourceWaypoint",
    "ViewSource",
    "add_appearances",
    "count_scenes",
    "make_dataset",
    "open_weights",
    "replay_datasets",
]
