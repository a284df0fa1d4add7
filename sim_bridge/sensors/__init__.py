"""What sensors add to exact renderings."""

from sim_bridge.sensors.colour import expose
from sim_bridge.sensors.depth import sense_depth
from sim_bridge.sensors.effects import encode
from sim_bridge.sensors.models import (
    IDEAL,
    LENSES,
    PRESETS,
    STANDARD,
    ColourSensor,
    DepthSensor,
    Motion,
    Sensors,
    bent,
    load_sensors,
    with_lens,
    with_quality,
    without,
    write_sensors,
)

__all__ = [
    "IDEAL",
    "LENSES",
    "PRESETS",
    "STANDARD",
    "ColourSensor",
    "DepthSensor",
    "Motion",
    "Sensors",
    "bent",
    "encode",
    "expose",
    "load_sensors",
    "sense_depth",
    "with_lens",
    "with_quality",
    "without",
    "write_sensors",
]
