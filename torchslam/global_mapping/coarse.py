"""Coarse maps of images whose poses are unknown: right to about a pixel, of all images or of a window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import Camera, rigid
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.global_mapping.baselines import chained_positions
from torchslam.global_mapping.rounds import (
    COARSE_GATE,
    FINE,
    MIN_VIEWS,
    ObservedTracks,
    Reconstruction,
    adjust_coarsely,
)
from torchslam.global_mapping.turning import turning_focal
from torchslam.global_mapping.view_graph import Relation, ViewPair, connected_views
from torchslam.global_mapping.windows import KnownPoses, rotations_hold
from torchslam.optim import ROTATION_OPTIONS
from torchslam.optim.rotation_averaging import solve_rotations
from torchslam.types import FrameFeatures

ROTATION_STD_RAD = 0.01
"""Standard deviation of the rotation of a pair with the mean number of matches: 0.15 to 0.3 degrees in the median on
real recordings, with a long tail. Tried 0.005 to 0.02."""
MIN_GENERAL = 0.2
"""Least share of pairs that determine a direction of motion: a camera that only turns has none, or, with a wrong focal
length, a few; walks have 0.8 and more."""
LEAST_AGREEING = 0.8
"""Least share of the observations of the longest tracks that known poses must agree with; else the images are mapped
anew. Windows of machine_hall (20 images) and redkitchen (40) have .96 to .99 by the poses of the online map. Tried at
this value only."""


class CoarseMap(NamedTuple):
    """Poses that are right to about a pixel.

    Attributes:
        pairs: that the map is from; learned: those of learned features; unposed: those with images without a pose.
        observed: the longest tracks.
        found: poses of all views, camera and the points of these tracks.
    """

    pairs: list[ViewPair]
    learned: list[ViewPair]
    observed: ObservedTracks
    found: Reconstruction
    unposed: list[ViewPair]


def _silent(stage: str, done: int, most: int) -> None:
    pass


@dataclass(frozen=True)
class CoarseMapper:
    """Maps images coarsely.

    Attributes:
        camera: of all images.
        given: the camera with its error; None: it is exact.
        threshold_px: distance from the epipolar line up to which matches were verified.
        progress: receives stages.
    """

    camera: Camera
    given: CameraMeasurement | None
    threshold_px: float
    progress: Callable[[str, int, int], None] = _silent

    def map(
        self, views: list[FrameFeatures], pairs: list[ViewPair], learned: list[ViewPair]
    ) -> CoarseMap | str:
        """Rotations, positions and coarse adjustment of views that are mapped together; why there is no map."""
        self.progress("rotations", 0, 1)
        own, pairs = len(pairs), pairs + learned
        if not pairs:
            return f"no map: no two of {len(views)} images show the same scene"
        edges = torch.tensor([(pair.first, pair.second) for pair in pairs], device=self.camera.params.device)
        R_21 = torch.stack([pair.T_21[:3, :3] for pair in pairs])
        weights = R_21.new_tensor([float(len(pair)) for pair in pairs])
        weights = weights / weights.mean() / ROTATION_STD_RAD**2
        average = solve_rotations(
            edges, R_21, len(views), weights, options=ROTATION_OPTIONS.replace(backward="detached")
        )
        held = rotations_hold(pairs, average.R_cw)
        own = sum(held[:own])
        pairs = list(compress(pairs, held))
        others = sum(pair.relation is not Relation.GENERAL for pair in pairs)
        if len(pairs) - others < MIN_GENERAL * len(pairs):
            about = f"{others} of {len(pairs)} pairs of images"
            return f"no map: the camera stands still, only turns, or sees a plane in {about}"
        focal = None if self.given is None else turning_focal(pairs, views, self.given, self.threshold_px)
        if focal is not None:
            return f"no map: the camera only turns, with a focal length of about {focal:.0f} px"
        connected = set(connected_views(pairs, len(views)).tolist())
        own = sum(pair.first in connected for pair in pairs[:own])
        pairs = [pair for pair in pairs if pair.first in connected]
        self.progress("positions", 0, 1)
        camera = self.camera if self.given is None else self.given.camera
        centers_w = chained_positions(pairs, average.R_cw, views, self.camera)
        T_cw = rigid(average.R_cw, -(average.R_cw @ centers_w[..., None])[..., 0])
        return self.adjust(views, pairs[:own], pairs[own:], T_cw, camera, [])

    def keep(
        self, known: KnownPoses, views: list[FrameFeatures], pairs: list[ViewPair], learned: list[ViewPair]
    ) -> CoarseMap | None:
        """The points of views whose poses are known, which stay as they are; None where too few agree."""
        R_cw = known.T_cw[:, :3, :3]
        own, more = (list(compress(each, rotations_hold(each, R_cw))) for each in (pairs, learned))
        observed = ObservedTracks.join(own + more, views).longest()
        found = observed.triangulate(known.T_cw, known.camera, COARSE_GATE * FINE[1])
        if float(found.agrees.sum()) < LEAST_AGREEING * max(len(found.agrees), 1):
            return None
        return CoarseMap(own, more, observed, found, [])

    def adjust(
        self,
        views: list[FrameFeatures],
        pairs: list[ViewPair],
        learned: list[ViewPair],
        T_cw: Float[Tensor, "K 4 4"],
        camera: Camera,
        unposed: list[ViewPair],
    ) -> CoarseMap | str:
        """Adjust approximate poses."""
        observed = ObservedTracks.join(pairs + learned, views)
        if observed.tracks.count == 0:
            return f"no map: no point is seen by {MIN_VIEWS} of {len(views)} images"
        self.progress("adjustment", 0, 1)
        observed = observed.longest()
        found = adjust_coarsely(observed, T_cw, self.given, camera, lambda words: self.progress(words, 0, 1))
        return CoarseMap(pairs, learned, observed, found, unposed)
