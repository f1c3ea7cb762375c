"""Localization problems from real images: where is a frame, given points triangulated from a few frames before?

Points come from matches of a base frame with two frames before it, triangulated with the reference poses; a later
frame is matched to them by descriptor alone. Every problem is made in both directions of time. Its world is the base
frame's camera, so errors are in meters without any alignment.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchslam.data.sequence import Sequence
from torchslam.features import ORB, hamming, match
from torchslam.geometry import Camera, estimate_absolute_pose, se3_inverse, transform, triangulate_many
from torchslam.learning.dataset import frames_in
from torchslam.types import Features

REFERENCES_S = (0.2, 0.4)  # seconds before the base frame that points are triangulated with
QUERIES_S = (0.5, 1.0, 2.0)  # seconds after it that frames are localized
BASES_PER_SECOND = 10
MAX_MATCHES = 400
MIN_MATCHES = 30
MAX_DISTANCE = 80  # bits; no ratio test, the network shall do better
MIN_PARALLAX = 0.003  # radians
MAX_TRIANGULATION_ERROR = 3.0  # pixels of the keypoint's level
RANSAC_PX = (1.5, 2.0, 3.0, 4.0, 6.0)
START_PX = 3.0  # the RANSAC threshold whose pose is the start of every refinement
_CHUNK = 64


@dataclass(frozen=True)
class Cues:
    """What is known of matches before any pose, (P, N) each.

    distances:                  bits, between the keypoint of the query and that of the base
    seconds_query:              bits, from the keypoint of the base to the second nearest one of the query
    seconds_base:               bits, from the keypoint of the query to the second nearest one with a point
    scales_query, scales_base:  pixels
    scores_query, scores_base:  logarithms of the detector's response, over the image's median
    turns:                      radians between the keypoints' directions
    parallaxes:                 radians, largest between the views that made the point
    views:                      their number
    errors:                     of the triangulation, root mean square over the views, pixels of their level
    """

    distances: Tensor
    seconds_query: Tensor
    seconds_base: Tensor
    scales_query: Tensor
    scales_base: Tensor
    scores_query: Tensor
    scores_base: Tensor
    turns: Tensor
    parallaxes: Tensor
    views: Tensor
    errors: Tensor


@dataclass(frozen=True)
class Problems:
    """P localization problems of N matches, padded.

    points:      (P, N, 3) in the camera frame of the base
    covariances: (P, N, 3, 3) of the points, for keypoints as good as one pixel of their level
    pixels:      (P, N, 2) in the query, undistorted, relative to the principal point
    mask:        (P, N) bool
    focals:      (P,) pixels
    T_true:      (P, 4, 4) base to query, by the reference poses
    T_given:     (P, 4, 4) the same by the ground truth that comes with the sequence
    spans:       (P, 2) seconds from the start of the sequence to the first and to the last of a problem's frames
    T_ransac:    (P, len(RANSAC_PX), 4, 4) by threshold
    """

    points: Tensor
    covariances: Tensor
    pixels: Tensor
    mask: Tensor
    cues: Cues
    focals: Tensor
    T_true: Tensor
    T_given: Tensor
    spans: Tensor
    T_ransac: Tensor

    def __len__(self) -> int:
        return len(self.focals)

    def __getitem__(self, rows: Tensor | slice) -> Problems:
        return _each(lambda x: x[rows], self)

    @property
    def T_start(self) -> Tensor:
        """(P, 4, 4) where every refinement starts."""
        return self.T_ransac[:, RANSAC_PX.index(START_PX)]

    @property
    def camera(self) -> Camera:
        """One per problem; the size only determines the error of a point that does not project."""
        zero = torch.zeros_like(self.focals)
        return Camera("pinhole", torch.stack([self.focals, self.focals, zero, zero], -1), (640, 480))

    @property
    def depths(self) -> Tensor:
        """(P,) median depth of the points in the base frame."""
        return self.points[..., 2].masked_fill(~self.mask, torch.nan).nanmedian(-1).values

    def to(self, device: torch.device) -> Problems:
        return _each(lambda x: x.to(device), self)

    def thinned(self, keys: Tensor, count: int) -> Problems:
        """At most `count` matches of each problem: those of the lowest keys (P, N)."""
        kept = keys.masked_fill(~self.mask, torch.inf).argsort(-1)[:, :count]

        def take(x: Tensor) -> Tensor:
            return x.gather(1, kept.view(*kept.shape, *[1] * (x.dim() - 2)).expand(*kept.shape, *x.shape[2:]))

        return replace(
            self,
            points=take(self.points),
            covariances=take(self.covariances),
            pixels=take(self.pixels),
            mask=take(self.mask),
            cues=_each(take, self.cues),
        )

    @staticmethod
    def cat(parts: list[Problems]) -> Problems:
        return _each(lambda *x: torch.cat(x), *parts)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(asdict(self), path)

    @staticmethod
    def load(path: Path) -> Problems:
        columns = torch.load(path, weights_only=True)
        return Problems(**columns | {"cues": Cues(**columns["cues"])})


T = TypeVar("T", Problems, Cues)


def _each(function: Callable[..., Tensor], *tables: T) -> T:
    """The function of every tensor of one table, or of the same tensor of several."""
    columns: dict[str, Any] = {}
    for field in fields(tables[0]):
        values = [getattr(table, field.name) for table in tables]
        columns[field.name] = function(*values) if isinstance(values[0], Tensor) else _each(function, *values)
    return type(tables[0])(**columns)


@dataclass(frozen=True)
class _Landmarks:
    """Points of a base frame, a row for each of its keypoints."""

    points: Tensor
    covariances: Tensor
    parallaxes: Tensor
    views: Tensor
    errors: Tensor
    mask: Tensor


def make_problems(sequence: Sequence, part: range, T_cw: Tensor) -> Problems:
    """The problems of a sequence with all their frames in a part of it; T_cw (frames, 4, 4), NaN where unknown."""
    back = [frames_in(seconds, sequence) for seconds in REFERENCES_S]
    ahead = [frames_in(seconds, sequence) for seconds in QUERIES_S]
    step = frames_in(1 / BASES_PER_SECOND, sequence)
    frames = _Frames(sequence, T_cw)
    problems: list[Problems | None] = []
    for base, direction in itertools.product(part[::step], (1, -1)):
        references = [base - direction * offset for offset in back]
        if not frames.usable([base, *references], part):
            continue
        landmarks = _triangulate(frames, base, references)
        queries = [base + direction * offset for offset in ahead]
        problems += [
            _localization(frames, references, base, query, landmarks)
            for query in queries
            if frames.usable([query], part)
        ]
    return with_ransac(Problems.cat([problem for problem in problems if problem is not None]))


class _Frames:
    """Keypoints as a camera without distortion sees them, and poses, by index; every image is read once."""

    def __init__(self, sequence: Sequence, T_cw: Tensor) -> None:
        self.sequence = sequence
        self.T_cw = T_cw
        self.focal = float(sequence.camera.focal)
        self.camera = Camera.pinhole(self.focal, self.focal, 0.0, 0.0, size=sequence.size)
        self._orb = ORB(1000)
        self._features: dict[int, Features] = {}

    def usable(self, indices: list[int], part: range) -> bool:
        """Whether all frames are in a part and have both poses."""
        return all(
            index in part
            and self.sequence.pose(index) is not None
            and bool(torch.isfinite(self.T_cw[index]).all())
            for index in indices
        )

    def features(self, index: int) -> Features:
        if index not in self._features:
            self._features[index] = self._orb(self.sequence.image(index))
        return self._features[index]

    def pixels(self, index: int) -> Tensor:
        """(N, 2) float64."""
        return self.sequence.camera.normalize(self.features(index).keypoints[0].double()) * self.focal

    def given_pose(self, index: int) -> Tensor:
        T_cw = self.sequence.pose(index)
        assert T_cw is not None, "frames are checked before they are used"
        return T_cw


def _triangulate(frames: _Frames, base: int, references: list[int]) -> _Landmarks:
    """Points from a base frame and references, from the views that agree with the reference poses."""
    T_wb = se3_inverse(frames.T_cw[base])
    features = frames.features(base)
    T_vb = frames.T_cw[[base, *references]] @ T_wb
    pixels, scales, seen = [frames.pixels(base)], [features.scales[0].double()], [features.mask[0]]
    for view in references:
        other = frames.features(view)
        matches = match(features, other, ratio=0.9, max_distance=MAX_DISTANCE)
        column = matches.indices_2[0]
        pixels.append(frames.pixels(view)[column])
        scales.append(other.scales[0].double()[column])
        seen.append(matches.mask[0])
    views_pixels, views_scales, views_seen = (torch.stack(x, 1) for x in (pixels, scales, seen))
    # A reference that does not agree with the base spoils the point: keep those that do, pair by pair.
    for view in range(1, len(T_vb)):
        pair = torch.tensor([0, view])
        two = triangulate_many(
            views_pixels[:, pair], T_cw=T_vb[pair], camera=frames.camera, mask=views_seen[:, pair]
        )
        agrees = two.mask & (two.errors < MAX_TRIANGULATION_ERROR * views_scales[:, pair]).all(-1)
        views_seen[:, view] &= agrees
    many = triangulate_many(views_pixels, T_cw=T_vb, camera=frames.camera, mask=views_seen)
    whitened = torch.where(views_seen, many.errors / views_scales, 0.0)
    mask = many.mask & (whitened < MAX_TRIANGULATION_ERROR).all(-1) & (many.angles > MIN_PARALLAX)
    views = views_seen.sum(-1)
    errors = (whitened.square().sum(-1) / views.clamp_min(1)).sqrt()
    covariances = _covariances(many.points_w, T_vb, views_seen / views_scales**2, frames.camera, mask)
    return _Landmarks(many.points_w, covariances, many.angles, views, errors, mask)


def _covariances(points: Tensor, T_vb: Tensor, weights: Tensor, camera: Camera, mask: Tensor) -> Tensor:
    """(N, 3, 3) inverse of the normal matrices of triangulations, weights (N, V); the identity outside the mask."""
    J = camera.project_with_point_jacobians(transform(T_vb, points))[2] @ T_vb[:, None, :3, :3]
    information = (weights.T[..., None, None] * (J.mT @ J)).sum(0)
    eye = torch.eye(3, dtype=points.dtype)
    covariances, singular = torch.linalg.inv_ex(torch.where(mask[:, None, None], information, eye))
    return torch.where((singular == 0)[:, None, None], covariances, eye)


def _localization(
    frames: _Frames, references: list[int], base: int, query: int, landmarks: _Landmarks
) -> Problems | None:
    """The problem of one query frame, still without RANSAC; None where it has too few matches."""
    features_base, features_query = frames.features(base), frames.features(query)
    known = replace(features_base, mask=landmarks.mask[None])
    matches = match(known, features_query, ratio=None, max_distance=MAX_DISTANCE)
    row = torch.nonzero(matches.mask[0])[:MAX_MATCHES, 0]
    if len(row) < MIN_MATCHES:
        return None
    column = matches.indices_2[0][row]
    bits = hamming(features_base.descriptors[0], features_query.descriptors[0]).float()
    bits = bits.masked_fill(~(landmarks.mask[:, None] & features_query.mask[0]), 256.0)
    turn = features_query.angles[0][column] - features_base.angles[0][row]
    cues = Cues(
        bits[row, column],
        bits[row].topk(2, largest=False).values[:, 1],
        bits[:, column].topk(2, dim=0, largest=False).values[1],
        features_query.scales[0][column],
        features_base.scales[0][row],
        _log_scores(features_query)[column],
        _log_scores(features_base)[row],
        torch.atan2(turn.sin(), turn.cos()),
        landmarks.parallaxes[row],
        landmarks.views[row],
        landmarks.errors[row],
    )

    times = (frames.sequence.timestamps - frames.sequence.timestamps[0])[[*references, base, query]]

    def padded(values: Tensor) -> Tensor:
        return torch.cat([values, values[:1].expand(MAX_MATCHES - len(values), *values.shape[1:])])[None]

    return Problems(
        padded(landmarks.points[row]),
        padded(landmarks.covariances[row]),
        padded(frames.pixels(query)[column]),
        torch.arange(MAX_MATCHES)[None] < len(row),
        _each(lambda x: padded(x.double()), cues),
        torch.tensor([frames.focal], dtype=torch.float64),
        (frames.T_cw[query] @ se3_inverse(frames.T_cw[base]))[None],
        (frames.given_pose(query) @ se3_inverse(frames.given_pose(base)))[None],
        torch.stack([times.min(), times.max()])[None],
        torch.empty(1, 0, 4, 4, dtype=torch.float64),
    )


def _log_scores(features: Features) -> Tensor:
    """(K,) of the keypoints of one image."""
    logarithms = features.scores[0].clamp_min(1e-12).log()
    return logarithms - logarithms[features.mask[0]].median()


def with_ransac(problems: Problems) -> Problems:
    """The problems with the poses that RANSAC finds; those for which it finds none at START_PX are left out."""
    results = [
        [
            estimate_absolute_pose(
                part.points, part.pixels, camera=part.camera, threshold=threshold, mask=part.mask
            )
            for threshold in RANSAC_PX
        ]
        for part in (problems[start : start + _CHUNK] for start in range(0, len(problems), _CHUNK))
    ]
    T_ransac = torch.cat([torch.stack([result.T_cw for result in row], 1) for row in results])
    found = torch.cat([row[RANSAC_PX.index(START_PX)].success for row in results])
    return replace(problems, T_ransac=T_ransac)[found]
