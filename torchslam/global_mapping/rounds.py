"""Rounds of bundle adjustment and filtering: wrong observations lose their weight, then leave.

The kernel starts wide and convex, so that a start that is pixels or tens of pixels off still attracts, and ends
redescending and narrow, so that what is wrong does not pull at all (graduated non-convexity: Black and Rangarajan, "On
the unification of line processes", 1996; Yang et al., "Graduated non-convexity for robust spatial perception", 2020).
After every round all observations of all tracks are tried anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import Camera, KeypointNoise, estimate_absolute_pose, se3_inverse, transform
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid
from torchslam.geometry.precision import in_dtype
from torchslam.geometry.robust import Kernel
from torchslam.global_mapping.tracks import (
    MIN_PARALLAX,
    Tracks,
    held_parts,
    join_matches,
    longest_tracks,
    parallax,
    triangulate_tracks,
)
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, solve_bundle
from torchslam.optim.observation_graph import camera_prior
from torchslam.types import FrameFeatures

COARSE: tuple[tuple[Kernel, float, float], ...] = (
    ("cauchy", 100.0, 1e-3),
    ("cauchy", 20.0, 1e-3),
    ("geman_mcclure", 6.0, 1e-4),
)
"""Kernels, their scales, in standard deviations of a keypoint, and tolerances, while poses are pixels off. Without the
first kernel both sides of a weak link of office_loop stay apart; Huber at 5 and 20 with wider gates ends at the same
minima. With tolerances of a tenth of these, errors of three recordings and seven parts of them are nearly the same, in
1.1 to 1.5 times the time of these rounds. Loops that hang on a few points, as at a door of office_loop, have several
minima, and which one is found is chance, with other kernels and tolerances too (experiments/global_mapping)."""
FINE: tuple[Kernel, float] = ("geman_mcclure", 5.0)
"""The same where poses are right to about a pixel. Tried 3 to 6, and Cauchy at 2, which is as good."""
COARSE_TRACKS = 150
"""Longest tracks of each image that the coarse rounds use: poses settle with these in a third of the time."""
ITERATIONS, TOLERANCE = 100, 1e-5
"""The scale of one part against another across a weak link changes the cost little: stopped at 1e-4, it is 5 % off. The
final adjustment goes on to 1e-6; after rounds to 1e-6 it ends at errors as above, in 1.4 to 2.3 times the time of these
rounds."""
COARSE_GATE, GATE = 3.0, 8.0
"""Up to where an observation belongs to its point: in coarse rounds in scales of the next kernel, then in standard
deviations. Narrower gates (3 to 6) leave out what could correct a weak link; the kernel makes up for the wide one."""
FINE_START = 1.5
"""Factor on the gate before the first fine round, as poses are right to about a pixel."""
MIN_VIEWS = 3
"""Images that must agree on a point: two rays nearly always meet somewhere."""
MIN_OBSERVATIONS = 15
"""Observations that must agree with the pose of an image. With a handful a pose is hardly determined, and a single one
that flies off stops the steps of all others. COLMAP asks for 30 to register an image."""
MIN_SHARED = 5
"""Points that must hold an image with its neighbors in a track. Parts that nothing holds go anywhere, and shrink to a
point where their own rays allow it: on office_loop such a part had one; right weak links there have 16 and more."""
MAX_ROUNDS, MIN_CHANGE = 4, 0.03
"""Fine rounds go on until less than this share of the observations changes sides. The final adjustment follows: with
.005 and one more round, eleven recordings and parts end at the same errors (within 3 %)."""


@dataclass(frozen=True)
class Reconstruction:
    """Poses, camera and the points of tracks.

    Attributes:
        T_cw: of the images.
        camera: of all images.
        points_w: of the tracks.
        agrees: observations that agree with their point.
    """

    T_cw: Float[Tensor, "K 4 4"]
    camera: Camera
    points_w: Float[Tensor, "N 3"]
    agrees: Bool[Tensor, " O"]


@dataclass(frozen=True)
class ObservedTracks:
    """Tracks with the pixels of their observations and the errors of these.

    Attributes:
        tracks: N of them.
        pixels: of the observations.
        noise: of the observations.
    """

    tracks: Tracks
    pixels: Float[Tensor, "O 2"]
    noise: KeypointNoise

    @classmethod
    def of(cls, tracks: Tracks, views: list[FrameFeatures]) -> ObservedTracks:
        """Read the observations of tracks in images."""
        counts = torch.tensor([len(view.mask) for view in views], device=tracks.view.device)
        at = (counts.cumsum(0) - counts)[tracks.view] + tracks.keypoint
        columns = (
            torch.cat([getattr(view, name) for view in views])[at]
            for name in ("keypoints", "scales", "information")
        )
        pixels, scales, information = columns
        return cls(tracks, pixels, KeypointNoise(scales, information).with_explicit_information())

    @classmethod
    def join(cls, pairs: list[ViewPair], views: list[FrameFeatures]) -> ObservedTracks:
        """The tracks of the matches of pairs that at least `MIN_VIEWS` images see."""
        tracks = join_matches(pairs, len(views), max(len(view.mask) for view in views))
        tracks, _ = tracks.select(torch.ones_like(tracks.track, dtype=torch.bool), MIN_VIEWS)
        return cls.of(tracks, views)

    def select(self, keep: Bool[Tensor, " N"]) -> ObservedTracks:
        """Some of the tracks, renumbered."""
        rows = keep[self.tracks.track]
        return ObservedTracks(self.tracks.select(rows, 1)[0], self.pixels[rows], self.noise[rows])

    def longest(self) -> ObservedTracks:
        """The tracks that the coarse rounds use."""
        return self.select(longest_tracks(self.tracks, COARSE_TRACKS))

    def errors(self, found: Reconstruction) -> Float[Tensor, " O"]:
        """Reprojection errors in standard deviations, infinite behind the camera."""
        T_cw = found.T_cw[self.tracks.view]
        points_c = transform(T_cw, found.points_w[self.tracks.track][:, None])[:, 0]
        pixels, valid = found.camera.project(points_c)
        distance = (pixels - self.pixels).norm(dim=-1) / self.noise.sigmas
        return distance.where(valid & (points_c[:, 2] > 0), torch.inf)

    def rays(self, T_cw: Float[Tensor, "K 4 4"], camera: Camera) -> tuple[Tensor, Tensor]:
        """Unit directions (O, 3) of the observations and the camera centers (O, 3) where they begin, in the world."""
        T_wc = se3_inverse(T_cw)[self.tracks.view]
        return (T_wc[:, :3, :3] @ camera.unproject(self.pixels)[..., None])[..., 0], T_wc[:, :3, 3]

    def triangulate(self, T_cw: Float[Tensor, "K 4 4"], camera: Camera, gate: float) -> Reconstruction:
        """The points of all tracks by given poses; `gate`: standard deviations up to which observations agree."""
        tolerance = gate * self.noise.sigmas / camera.focal
        found = triangulate_tracks(self.tracks, *self.rays(T_cw, camera), tolerance)
        return self.filter(Reconstruction(T_cw, camera, *found), gate)

    def complete(self, found: Reconstruction, gate: float) -> Reconstruction:
        """Try all observations, and other points where more observations agree with these than with the present ones.

        Points by rays alone are not at the minimum: with these for all, the next adjustment takes as long as this one.
        """
        kept, anew = self.filter(found, gate), self.triangulate(found.T_cw, found.camera, gate)
        most, least = (
            torch.bincount(self.tracks.track[each.agrees], minlength=self.tracks.count)
            for each in (anew, kept)
        )
        points_w = torch.where((most > least)[:, None], anew.points_w, kept.points_w)
        return self.filter(replace(found, points_w=points_w), gate)

    def filter(self, found: Reconstruction, gate: float) -> Reconstruction:
        """Try all observations: those within the gate, of points that enough images see under an angle."""
        agrees = self.errors(found) < gate
        held = torch.bincount(self.tracks.view[agrees], minlength=len(found.T_cw)) >= MIN_OBSERVATIONS
        agrees = agrees & held[self.tracks.view]
        centers_w = se3_inverse(found.T_cw)[self.tracks.view, :3, 3]
        angles = parallax(self.tracks, centers_w, found.points_w, agrees)
        count = torch.bincount(self.tracks.track[agrees], minlength=self.tracks.count)
        good = (count >= MIN_VIEWS) & (angles > MIN_PARALLAX)
        return replace(found, agrees=agrees & good[self.tracks.track])

    def resect(self, found: Reconstruction) -> Reconstruction:
        """Pose the images of which too few observations agree anew, by the points that other images agree on."""
        counts = torch.bincount(self.tracks.view[found.agrees], minlength=len(found.T_cw))
        known = torch.zeros(self.tracks.count, dtype=torch.bool, device=counts.device)
        known[self.tracks.track[found.agrees]] = True
        T_cw, changed = found.T_cw.clone(), False
        for view in torch.nonzero(counts < MIN_OBSERVATIONS)[:, 0].tolist():
            rows = torch.nonzero((self.tracks.view == view) & known[self.tracks.track])[:, 0]
            if len(rows) < MIN_OBSERVATIONS:
                continue
            points_w = found.points_w[self.tracks.track[rows]]
            threshold = FINE[1] * float(self.noise.sigmas[rows].median())
            pose = estimate_absolute_pose(
                points_w[None], self.pixels[rows][None], camera=found.camera, threshold=threshold
            )
            if bool(pose.success[0]):
                T_cw[view], changed = pose.T_cw[0], True
        return replace(found, T_cw=T_cw) if changed else found


def adjust(
    observed: ObservedTracks,
    found: Reconstruction,
    kernel: Kernel,
    scale: float,
    tolerance: float,
    given: CameraMeasurement | None,
) -> Reconstruction:
    """Adjust poses and points, and the camera with its prior if given, by the observations that agree.

    In float32, relative to the middle of the cameras: at the ends of a path 5,000 times as long as points are far, with
    a focal length of 600 px, rounding moves projections by .06 px in the median. The final adjustment, in float64,
    begins where this ends.
    """
    tracks, former = observed.tracks.select(found.agrees)
    rows = found.agrees & torch.isin(observed.tracks.track, former)
    middle_w = torch.eye(4, dtype=found.T_cw.dtype, device=found.T_cw.device)
    middle_w[:3, 3] = se3_inverse(found.T_cw)[:, :3, 3].mean(0)
    problem = BundleProblem(
        found.T_cw @ middle_w,
        found.points_w[former] - middle_w[:3, 3],
        tracks.view,
        tracks.track,
        observed.pixels[rows],
        found.camera,
        weights=observed.noise[rows].weights,
        camera_prior=None if given is None else camera_prior(given),
    )
    free: bool | Tensor = False if given is None else given.directions.float()
    solution = solve_bundle(
        in_dtype(problem, torch.float32),
        free_camera=free,
        check=False,
        options=BUNDLE_OPTIONS.replace(
            kernel=kernel, scale=scale, iterations=ITERATIONS, tolerance=tolerance, backward="detached"
        ),
    )
    T_cw, camera = solution.T_cw.to(found.T_cw), solution.camera.to(found.camera.params)
    # They are rotations only to the rounding of float32.
    R_cw = matrix_from_quaternion(quaternion_from_matrix(T_cw[:, :3, :3]))
    T_cw = rigid(R_cw, T_cw[:, :3, 3]) @ se3_inverse(middle_w)
    points_w = found.points_w.clone()
    points_w[former] = solution.points_w.to(points_w) + middle_w[:3, 3]
    return Reconstruction(T_cw, camera, points_w, found.agrees)


def adjust_coarsely(
    observed: ObservedTracks,
    T_cw: Float[Tensor, "K 4 4"],
    given: CameraMeasurement | None,
    camera: Camera,
    log: Callable[[str], None] = lambda words: None,
) -> Reconstruction:
    """Find poses that are right to about a pixel, and the camera, from poses that may be many pixels off.

    Args:
        observed: the longest tracks.
        T_cw: approximate poses.
        given: the given camera with its error, a prior; None: the camera is exact.
        camera: to start with.
        log: receives what each round found.
    """
    found = observed.triangulate(T_cw, camera, COARSE_GATE * COARSE[0][1])
    gates = [scale for _, scale, _ in COARSE[1:]] + [FINE[1]]
    for (kernel, scale, tolerance), following in zip(COARSE, gates, strict=True):
        found = adjust(observed, found, kernel, scale, tolerance, given)
        found = observed.filter(found, COARSE_GATE * following)
        log(f"{kernel} {scale:g}: {int(found.agrees.sum())} of {len(observed.tracks)} observations agree")
    return found


def adjust_in_rounds(
    observed: ObservedTracks,
    T_cw: Float[Tensor, "K 4 4"],
    given: CameraMeasurement | None,
    camera: Camera,
    coarse: bool = True,
    log: Callable[[str], None] = lambda words: None,
) -> Reconstruction:
    """Find poses, points, camera and the observations that agree, from approximate poses.

    Args:
        observed: the tracks.
        T_cw: approximate poses.
        given: the given camera with its error, a prior; None: the camera is exact.
        camera: to start with.
        coarse: whether poses may be many pixels off.
        log: receives what each round found.
    """
    if coarse:
        begun = adjust_coarsely(observed.longest(), T_cw, given, camera, log)
        T_cw, camera = begun.T_cw, begun.camera
    found = observed.triangulate(T_cw, camera, FINE_START * GATE)
    for number in range(MAX_ROUNDS):
        before = found.agrees
        posed = observed.resect(found)
        if posed is not found:
            found = observed.triangulate(posed.T_cw, found.camera, GATE)
        found = observed.complete(adjust(observed, found, *FINE, TOLERANCE, given), GATE)
        change = float((found.agrees != before).double().mean())
        log(f"round {number + 1}: {int(found.agrees.sum())} observations agree, {change:.1%} changed")
        if change < MIN_CHANGE:
            break
    part = held_parts(observed.tracks, found.agrees, len(found.T_cw), MIN_SHARED)
    largest = torch.bincount(part).argmax()
    return replace(found, agrees=found.agrees & (part == largest)[observed.tracks.view])
