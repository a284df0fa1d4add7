"""Whether the lenses of a session's sensors can be drawn: asked before anything is made."""

from __future__ import annotations

from fieldkit.errors import CameraError
from sim_bridge import robot
from sim_bridge.errors import SynthesisError
from sim_bridge.mapping import mapper, photographer
from sim_bridge.rendering import check_camera
from sim_bridge.sensors import Sensors, bent


def refuse_lenses(sensors: Sensors, *, where: str) -> None:
    """Raise SynthesisError that names ``where`` (a file) and the sensor whose lens no picture can be drawn through."""
    cameras = {"hand": robot.ARM_CAMERA, "mapping": mapper.VLC, "photos": photographer.PHOTO_CAMERA}
    for name, camera in cameras.items():
        try:
            check_camera(bent(camera, getattr(sensors, name)))
        except CameraError as error:
            raise SynthesisError(
                f"{where}: [{name}.lens]: {error.message}", hint="weaken the lens's coefficients"
            ) from error
