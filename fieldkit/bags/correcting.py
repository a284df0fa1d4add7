"""Put what a laboratory knows better in the place of what a recording states of its camera, before frames are made."""

from __future__ import annotations

from fieldkit.bags.content import Content, arm_chain
from fieldkit.bags.files import BagFile
from fieldkit.bags.images import decode_image
from fieldkit.bags.layouts import Layout
from fieldkit.bags.tf import clean_frame
from fieldkit.cameras import Camera
from fieldkit.errors import BagError, suggestion
from fieldkit.frames import Pose
from fieldkit.store import Corrections, Hand


def correct(bag: BagFile, content: Content, corrections: Corrections | None, *, layout: Layout) -> list[str]:
    """Correct the camera, its place in the hand and the latency of stamps in a bag's content; return what to warn of.

    Frames, views and detections that are made of it afterwards have the corrected values. Raises BagError where the
    camera has another resolution than the images, or the hand's frames are not those between body and images.
    """
    warnings: list[str] = []
    if corrections is None:
        return warnings
    if corrections.hand is not None:
        _correct_hand(bag, content, corrections.hand, corrections.name("hand"), layout=layout)
        content.late_ns = corrections.late_ns
    if corrections.camera is not None:
        warnings += _correct_camera(bag, content, corrections.camera, corrections.name("camera"))
    return warnings


def _correct_camera(bag: BagFile, content: Content, camera: Camera, name: str) -> list[str]:
    size = _image_size(bag, content)
    if size is not None and size != (camera.width, camera.height):
        raise BagError(
            f"{name}: is for images of {camera.width}x{camera.height}; expected {size[0]}x{size[1]}, the resolution of "
            f"those in {bag.path}",
            hint="refine or calibrate the camera at the resolution that was recorded",
        )
    content.corrected, content.camera_error = camera, None
    stated = len({c for _, c in content.cameras})
    return [f"{name} replaces {stated} different calibrations of the recording"] if stated > 1 else []


def _image_size(bag: BagFile, content: Content) -> tuple[int, int] | None:
    """Return the size of the images, by CameraInfo where there is none that can be read; None where nothing says it."""
    for image in content.images[:1]:
        try:
            height, width = decode_image(bag.message(image.place)).shape[:2]
            return width, height
        except ValueError:
            break
    return next(((c.width, c.height) for _, c in content.cameras), None)


def _correct_hand(bag: BagFile, content: Content, hand: Hand, name: str, *, layout: Layout) -> None:
    parent, child = clean_frame(hand.parent), clean_frame(hand.child)
    for what, frame in (("parent", parent), ("child", child)):
        if frame not in content.tf.frames:
            raise BagError(
                f"{name}: its {what} {frame!r} is no frame of tf in {bag.path}; expected one of them",
                hint=suggestion(frame, content.tf.frames),
            )
    images = sorted({image.frame or layout.camera_frame for image in content.images} or {layout.camera_frame})
    if images != [child]:
        raise BagError(
            f"{name}: its child is {child!r}; expected the frame of the images in {bag.path}, {', '.join(images)}",
            hint="give the hand.toml of this camera",
        )
    body = content.odometry.child or layout.body_frame
    t_ns, steps = arm_chain(bag.path, content, body=body, camera=child)
    above = [frame for frame, _, _ in steps]
    if parent not in above:
        raise BagError(
            f"{name}: its parent {parent!r} does not carry {child!r} in {bag.path}; expected a frame between the body "
            f"and the images: {', '.join(above)}",
            hint="give the hand.toml of this robot",
        )
    fixed = steps[above.index(parent) :]
    moving = next((f"{b!r} in {a!r}" for a, b, moves in fixed if moves), None)
    if moving is not None:
        raise BagError(
            f"{name}: tf moves {moving} in {bag.path}; expected a transform from {parent!r} to {child!r} that never "
            "changes",
            hint="give a hand.toml whose parent is the frame that carries the camera",
        )
    _replace(content, parent, above[-1], hand.hand_from_cam, child=child, t_ns=t_ns)


def _replace(content: Content, parent: str, last: str, parent_from_child: Pose, *, child: str, t_ns: int) -> None:
    """Replace the last step of a fixed chain from parent over ``last`` to child so that the chain becomes the given."""
    placed = parent_from_child
    if last != parent:
        placed = content.tf.lookup(parent, last, t_ns=t_ns).inv() * parent_from_child
    content.tf.replace_static(last, child, placed)
