"""Training of the learned policies: from dataset folders to weights, their calibration and their card."""

from fieldkit.training.calibrating import Calibration, Reliability, chosen_share, fit_calibration, reliability
from fieldkit.training.examples import Examples, find_scenes, read_examples, split_scenes
from fieldkit.training.rules import TrainingRules
from fieldkit.training.training import TrainingReport, train

__all__ = [
    "Calibration",
    "Examples",
    "Reliability",
    "TrainingReport",
    "TrainingRules",
    "chosen_share",
    "find_scenes",
    "fit_calibration",
    "read_examples",
    "reliability",
    "split_scenes",
    "train",
]
