"""What a calibration came to, in words, and whether a run contradicts the camera that it was given."""

from __future__ import annotations

import math

from torchslam.calibration.intrinsics import Refinement
from torchslam.calibration.rounds import FoundCamera
from torchslam.geometry import Camera

# When the images contradict a given focal length: by so many standard errors and this share, or by a larger share
# with a cost that is lower by a share of its own.
CERTAIN, NOTABLE = 3.0, 0.01
LARGE, LOWER = 0.03, 0.02
SUFFERS = "poses and map may be badly wrong with it"
OPEN = "pure rotation, a straight way and a plane leave it open"


def describe_camera(calibrated: FoundCamera) -> str:
    """The camera that was found and its standard errors, or that it is not determined and how wrong it may be."""
    camera, refined = calibrated.camera, calibrated.refined
    if refined is None:
        return (
            f"unknown: no map could be made; the focal length of {float(camera.focal):.0f} px is a guess, which may be "
            "wrong by a factor of two"
        )
    if not refined.is_determined:
        wrong = f"{200 * refined.std:.0f} %" if refined.std < 0.5 else "a factor of two"
        return (
            f"not determined by the motion ({OPEN}): the focal length of {float(camera.focal):.0f} px may be wrong "
            f"by {wrong}"
        )
    terms = zip(camera.params[4:6].tolist(), refined.k_std, ("k1", "k2"), strict=False)
    bends = [f"{name} {k:.3f} ± {std:.3f}" for k, std, name in terms]
    return ", ".join([f"focal length {_focal(refined, refined.std)}", *(bends or ["no other distortion"])])


def contradiction(given: Camera, refined: Refinement) -> str:
    """That the images agree better with another focal length than the given one, empty where they do not.

    refined: with the focal length alone free
    """
    was, focal = float(given.focal), float(refined.camera.focal)
    off = abs(math.log(focal / was))
    lower = 1 - refined.cost / refined.cost_before if refined.cost_before > 0 else 0.0
    certain = off > max(NOTABLE, CERTAIN * refined.given_rest)
    if not certain and not (off > LARGE and lower > LOWER):
        return ""
    if not refined.is_determined:
        return (
            f"the images contradict a focal length of {was:.0f} px and do not say which is right; {SUFFERS}"
        )
    better = "the images agree better with a focal length of"
    if off <= LARGE:
        return f"{better} {_focal(refined, refined.given_rest)} than with {was:.0f}"
    # A run chooses its matches by the camera it has: far off, they lead only most of the way to the right one.
    return f"{better} {focal:.0f} px or {'more' if focal > was else 'less'} than with {was:.0f}; {SUFFERS}"


def _focal(refined: Refinement, std: float) -> str:
    focal = float(refined.camera.focal)
    error = focal * std
    return f"{focal:.0f} ± {error:.0f} px" if error >= 1 else f"{focal:.1f} ± {error:.1f} px"
