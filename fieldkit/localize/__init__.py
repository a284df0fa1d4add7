"""The localizer: an image and a map in, a camera pose with covariance and seconds per stage out."""

from fieldkit.localize.localizer import Inliers, Localizer, Query, RigEstimate
from fieldkit.localize.narrowing import CameraPrior
from fieldkit.localize.parallel import default_threads, in_threads

__all__ = ["CameraPrior", "Inliers", "Localizer", "Query", "RigEstimate", "default_threads", "in_threads"]
