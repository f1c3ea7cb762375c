"""Faults of cameras, recorders and operators, applied to a sequence with ground truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from experiments.trials import edits
from experiments.trials.edited import Edit, Edited, fitted, shots, strangers
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera

KIDNAPPED = 40  # frames
LENT = 5  # the frame of the other sequence that is used

Fault = Callable[[Sequence, Sequence], Edited]
"""From a sequence and one of another place to an edited one."""


def everywhere(make: Callable[[Sequence, Sequence], Edit]) -> Fault:
    """The same edit in all frames."""

    def fault(whole: Sequence, other: Sequence) -> Edited:
        return Edited(whole.name, whole.camera, shots(whole, range(len(whole)), make(whole, other)))

    return fault


def covered(share: float, speed: int) -> Fault:
    """An occluder from another place passes in front of the camera."""

    def make(whole: Sequence, other: Sequence) -> Edit:
        lent = np.rint(255 * other.image(LENT)[0, 0].numpy()).astype(np.uint8)
        return edits.occluder(fitted(lent, whole.size), share, speed)

    return everywhere(make)


def none(whole: Sequence, other: Sequence) -> Edited:
    """For comparison."""
    return every(1)(whole, other)


def every(stride: int) -> Fault:
    """Frames are dropped."""

    def fault(whole: Sequence, other: Sequence) -> Edited:
        return Edited(whole.name, whole.camera, shots(whole, range(0, len(whole), stride)))

    return fault


def kidnapped(whole: Sequence, other: Sequence) -> Edited:
    """Frames of another place in the middle."""
    middle = len(whole) // 2
    before, after = shots(whole, range(middle)), shots(whole, range(middle, len(whole)))
    return Edited(whole.name, whole.camera, before + strangers(other, range(KIDNAPPED)) + after)


def half_resolution(whole: Sequence, other: Sequence) -> Edited:
    """Images of half the size, with the camera that belongs to them."""
    return Edited(whole.name, halved(whole.camera), shots(whole, range(len(whole))))


def halved(camera: Camera) -> Camera:
    """The camera of images of half the width and height, of which each pixel is the mean of four."""
    params = camera.params.clone()
    params[:2] *= 0.5
    params[2:4] = (params[2:4] + 0.5) * 0.5 - 0.5
    return Camera(camera.model, params, (camera.width // 2, camera.height // 2))


FAULTS: dict[str, Fault] = {
    "none": none,
    "overlay": everywhere(lambda whole, _: edits.overlay(whole.size)),
    "logo_small": everywhere(lambda *_: edits.small_logo()),
    "occluder30": covered(0.3, 6),
    "occluder50": covered(0.5, 4),
    "rolling6px": everywhere(lambda *_: edits.rolling(6.0)),
    "lensdirt": everywhere(lambda whole, _: edits.lens_dirt(whole.size)),
    "vignette": everywhere(lambda *_: edits.vignette),
    "blur9": everywhere(lambda *_: edits.motion_blur(9)),
    "blur15": everywhere(lambda *_: edits.motion_blur(15)),
    "noise25": everywhere(lambda *_: edits.noise(25.0)),
    "pale20": everywhere(lambda *_: edits.pale(0.2)),
    "jpeg10": everywhere(lambda *_: edits.jpeg(10)),
    "exposure_step": everywhere(lambda *_: edits.exposure_step),
    "overexposed": everywhere(lambda *_: edits.brighter(3.0)),
    "kidnap": kidnapped,
    "drop3": every(3),
    "halfres": half_resolution,
}
