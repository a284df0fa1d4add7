"""What is wrong with a recording's odometry, told from its messages: stamps, times of arrival, poses."""

from __future__ import annotations

import numpy as np

from fieldkit.bags.content import Content, PoseSamples, read_odometry
from fieldkit.bags.files import BagFile
from fieldkit.odometry import find_faults, summarize_faults
from fieldkit.types import OdometryFault


def odometry_faults(content: Content, samples: PoseSamples | None = None) -> tuple[OdometryFault, ...]:
    """Find the faults of a recording's odometry, or of other samples; the images' times of arrival are the measure."""
    used = content.odometry if samples is None else samples
    lags = [image.place.log_ns - image.t_ns + content.late_ns for image in content.images]
    return find_faults(
        np.array([t for t, _ in used.samples], dtype=np.int64),
        [p for _, p in used.samples],
        received_ns=np.array(used.received, dtype=np.int64),
        image_latency_ns=float(np.median(lags)) if lags else None,
    )


def odometry_elsewhere(bag: BagFile, content: Content) -> list[str]:
    """Return what is wrong with odometry on topics that the layout does not name, one line per kind of fault."""
    lines = []
    for name, topic in sorted(bag.topics.items()):
        if topic.type == "nav_msgs/msg/Odometry" and topic.count:
            faults = odometry_faults(content, read_odometry(bag, name))
            lines += [line.replace("odometry:", f"odometry on {name}:", 1) for line in summarize_faults(faults)]
    return lines


def covariance_warnings(content: Content, topic: str) -> list[str]:
    """Return one line where the reference topic states covariances that cannot be used, and what is used instead."""
    samples = content.reference
    stated = sum(c is not None for c in samples.covariances)
    unstated = len(samples.covariances) - stated - samples.refused.total()
    reasons = [f"{n} {what}" for what, n in sorted(samples.refused.items())]
    if unstated and (stated or reasons):
        reasons.append(f"{unstated} not stated")
    if not reasons:
        return []
    instead = "that of the nearest sample that states one" if stated else "5 mm and 0.2 deg per axis"
    return [
        f"{topic}: of {len(samples.covariances)} covariances {', '.join(reasons)}; used for these samples: {instead}"
    ]
