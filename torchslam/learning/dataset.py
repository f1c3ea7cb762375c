"""A data set of clips of sequences: selected once by the parallax of their images, read on access."""

from __future__ import annotations

import copy
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.data import Dataset, Sampler, Subset

from torchslam.data.sequence import Sequence
from torchslam.errors import ClipError, SequenceError
from torchslam.features import ORB, match
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse
from torchslam.learning.clip_slam import ClipGraph, ClipSLAM
from torchslam.learning.training import seed_of
from torchslam.types import Features

MIN_MATCHES = 50  # between the first and the last frame of a clip; with fewer they hardly overlap
MIN_PARALLAX = 0.05
"""Radians, three degrees, between these frames. With it the system poses 45 of 48 clips of redkitchen, machine_hall,
kitti07 and fr2_desk_20; with two degrees 3 of 8 of redkitchen, but a car shows no more than that."""


@dataclass(frozen=True)
class Clip:
    """T frames of a sequence, or B clips of T frames.

    Attributes:
        images: Gray, in [0, 1].
        T_cw: True poses, world to camera, meters, float64; the identity where unknown.
        known: Whether there is a true pose.
        camera: With params (P,) or (B, P).
        number: Index in the data set.
    """

    images: Float[Tensor, "*batch T 1 H W"]
    T_cw: Float[Tensor, "*batch T 4 4"]
    known: Bool[Tensor, "*batch T"]
    camera: Camera
    number: Int[Tensor, "*batch"]

    @classmethod
    def of(
        cls,
        sequence: Sequence,
        start: int,
        frames: int,
        stride: int,
        number: int = 0,
        supervised: bool = False,
    ) -> Clip:
        """Read the T frames `start`, `start + stride`, ... of a sequence with a camera.

        Raises:
            SequenceError: The sequence is too short or, if `supervised`, lacks the true pose of one of the frames.
        """
        indices = range(start, start + frames * stride, stride)
        if indices[-1] >= len(sequence):
            raise SequenceError(
                f"{sequence.name}: {frames} frames from {start}, {stride} apart, exceed its {len(sequence)} frames"
            )
        found = [sequence[index] for index in indices]
        known = torch.tensor([frame.T_cw_groundtruth is not None for frame in found], device="cpu")
        if supervised and not known.all():
            raise SequenceError(f"{sequence.name}: a frame of the clip from {start} on has no true pose")
        eye = torch.eye(4, dtype=torch.float64, device="cpu")
        poses = [eye if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth for frame in found]
        return cls(
            torch.cat([frame.image for frame in found]),
            torch.stack(poses),
            known,
            sequence.camera,
            torch.tensor(number, device="cpu"),
        )

    def to(self, device: torch.device | str) -> Clip:
        """Move the images to a device; poses and camera stay."""
        return replace(self, images=self.images.to(device))


def collate(clips: Several[Clip]) -> Clip:
    """Stack clips of one each into one of B clips, with a camera for each; for `DataLoader(collate_fn=collate)`.

    Pinhole cameras get distortion coefficients of zero where others are distorted.

    Raises:
        ValueError: Different sizes or numbers of frames, or fisheye cameras mixed with others.
    """
    sizes = {tuple(clip.images.shape) for clip in clips}
    if len(sizes) > 1 or len({clip.camera.size for clip in clips}) > 1:
        raise ValueError(
            f"clips of a batch must have the same number and size of frames, not {sorted(sizes)}"
        )
    camera = stack_cameras([clip.camera for clip in clips])
    names = ("images", "T_cw", "known", "number")
    return Clip(
        camera=camera, **{name: torch.stack([getattr(clip, name) for clip in clips]) for name in names}
    )


def stack_cameras(cameras: Several[Camera]) -> Camera:
    """Stack B cameras into one with params (B, P). Raises ValueError for sizes or models that cannot be mixed."""
    nested = ("pinhole", "radial_tangential", "rational")  # each is the next one with zeros at the end
    if all(camera.model in nested for camera in cameras):
        model = max((camera.model for camera in cameras), key=nested.index)
        width = max(camera.params.shape[-1] for camera in cameras)
        padded = [torch.nn.functional.pad(c.params, (0, width - c.params.shape[-1])) for c in cameras]
        cameras = [Camera(model, params, c.size) for c, params in zip(cameras, padded, strict=True)]
    return Camera.stack(cameras)


def frames_in(seconds: float, sequence: Sequence) -> int:
    """Return the number of frames in a time, at least one."""
    return max(1, round(seconds * sequence.frame_rate))


class Clips(Dataset[Clip]):
    """Clips of sequences with enough motion to determine depth, ordered by sequence and time.

        clips = Clips([open_sequence("redkitchen")], per_sequence=100)
        loader = DataLoader(clips, batch_sampler=Batches(len(clips), 4), collate_fn=collate)

    A clip starts at a random frame. Its stride is the least of 1, 2, 4, ... for which matches between the first and
    the last frame have a median parallax of `min_parallax`. Starts without such a stride, or with fewer than
    `MIN_MATCHES` matches, are skipped. The same arguments give the same clips.

    Attributes:
        chosen: (sequence, start, stride) of each clip.

    Args:
        sequences: Sequences with cameras.
        frames: T, frames of a clip.
        per_sequence: Maximum number of clips of each sequence, starting at different frames.
        min_parallax: Radians.
        max_stride: Frames.
        supervised: Whether every frame of a clip must have a true pose.
        seed: Of the starts.

    Raises:
        CalibrationError: A sequence without a camera.
        FrameError: An image that cannot be read.
    """

    def __init__(
        self,
        sequences: Iterable[Sequence],
        frames: int = 8,
        per_sequence: int = 100,
        min_parallax: float = MIN_PARALLAX,
        max_stride: int = 16,
        supervised: bool = True,
        seed: int = 0,
    ) -> None:
        """Select the clips."""
        self.sequences, self.frames = list(sequences), frames
        self.chosen: list[tuple[int, int, int]] = []
        generator, orb = torch.Generator().manual_seed(seed), ORB(500)
        for number, sequence in enumerate(self.sequences):
            features_of = cache(lambda index, images=sequence: orb(images.image(index)))  # each is read once
            found: dict[int, int] = {}
            for start in torch.randperm(len(sequence), generator=generator, device="cpu").tolist():
                if len(found) == per_sequence:
                    break
                stride = _stride(sequence, features_of, start, frames - 1, min_parallax, max_stride)
                clip = range(start, start + frames * stride, stride) if stride else ()
                if clip and not (supervised and any(sequence.pose(index) is None for index in clip)):
                    found[start] = stride
            self.chosen += [(number, start, found[start]) for start in sorted(found)]

    def __len__(self) -> int:
        """The number of clips."""
        return len(self.chosen)

    def __getitem__(self, number: int) -> Clip:
        """Read a clip. Raises FrameError."""
        sequence, start, stride = self.chosen[number]
        return Clip.of(self.sequences[sequence], start, self.frames, stride, number)


class Batches(Sampler[list[int]]):
    """Endless batches of indices for `DataLoader(batch_sampler=...)`, in a new order every epoch.

    Each batch depends only on its number and on the arguments, so resumed training sets `first`.

    Args:
        length: Of the data set.
        batch: Clips of a batch, on each process.
        seed: Of the order.
        first: Number of the first batch.
        rank: Of this process.
        ranks: Number of processes.

    Raises:
        ValueError: No clips, or batches without clips.
    """

    def __init__(
        self, length: int, batch: int, seed: int = 0, first: int = 0, rank: int = 0, ranks: int = 1
    ) -> None:
        """Keep the arguments."""
        if length < 1 or batch < 1:
            raise ValueError(f"batches need at least one clip: batch size {batch}, {length} clips")
        self.length, self.batch, self.seed, self.first = length, batch, seed, first
        self.rank, self.ranks = rank, ranks

    def __iter__(self) -> Iterator[list[int]]:
        """Iterate over batches from `first` on, without end."""
        epoch, order = -1, torch.empty(0, dtype=torch.float32, device="cpu")
        for number in itertools.count(self.first):
            rows = []
            begin = (number * self.ranks + self.rank) * self.batch
            for place in range(begin, begin + self.batch):
                if place // self.length != epoch:
                    epoch = place // self.length
                    generator = torch.Generator().manual_seed(seed_of(self.seed, epoch))
                    order = torch.randperm(self.length, generator=generator, device="cpu")
                rows.append(int(order[place % self.length]))
            yield rows


class GraphCache:
    """Graphs of the clips of a data set, each built once, by a copy of the initial feature extractor.

    The graph of a clip therefore does not depend on when it first occurs, and resumed training sees the same graphs.
    """

    def __init__(self, clip_slam: ClipSLAM) -> None:
        """Copy the feature extractor and the configuration of a module."""
        self._clip_slam = ClipSLAM(copy.deepcopy(clip_slam.extractor), config=clip_slam.config)
        self._graphs: dict[int, ClipGraph] = {}

    def __call__(self, clips: Clip) -> ClipGraph:
        """Return the graph of a batch made by `collate`."""
        numbers = clips.number.tolist()
        for row, number in enumerate(numbers):
            if number not in self._graphs:
                self._graphs[number] = self._clip_slam.build_graph(clips.images[row], clips.camera[row])
        return ClipGraph.stack([self._graphs[number] for number in numbers])


def clips_with_a_map(clips: Clips, graphs: GraphCache) -> tuple[Subset[Clip], Counter[str]]:
    """Select the clips whose start finds a map; the graphs of all of them are built.

    Returns:
        These clips, and how many of the others have no map for which reason (`count_reasons`).

    Raises:
        ClipError: There is none.
    """
    reasons: list[str] = []
    for number in range(len(clips)):
        reasons += graphs(collate([clips[number]])).reasons
    usable = [number for number, reason in enumerate(reasons) if not reason]
    left_out = count_reasons(reasons)
    if not clips.chosen:
        raise ClipError(
            "no clips: the sequences are too short, their camera moves too little (min_parallax), or they have no true "
            "poses (supervised=False needs none)"
        )
    if not usable:
        why = "; ".join(f"{count} of them: {reason}" for reason, count in left_out.most_common())
        raise ClipError(
            f"none of {len(clips)} clips finds a map: take longer clips, a larger min_parallax, or a better camera; "
            f"{why}"
        )
    return Subset(clips, usable), left_out


def count_reasons(reasons: Iterable[str]) -> Counter[str]:
    """Count the reasons of failed clips, those together that differ in their numbers; empty ones do not count."""
    return Counter(re.sub(r": \d.*", "", reason) for reason in reasons if reason)


@torch.no_grad()
def parallax(
    first: Features, second: Features, camera: Camera, R_21: Float[Tensor, "3 3"] | None = None
) -> float:
    """Measure the median angle between the rays of matches after rotation compensation, in radians.

    Args:
        first, second: Features of two images of a camera.
        camera: Of both.
        R_21: Rotation from the first camera to the second; estimated if None.

    Returns:
        Radians; zero with fewer than `MIN_MATCHES` matches, or if the relative pose cannot be estimated.
    """
    matches = match(first, second)
    rows = matches.mask[0].nonzero().squeeze(-1)
    if len(rows) < MIN_MATCHES:
        return 0.0
    pixels_1 = first.keypoints[0, matches.indices_1[0, rows]].to(camera.params.dtype)
    pixels_2 = second.keypoints[0, matches.indices_2[0, rows]].to(camera.params.dtype)
    if R_21 is None:
        motion = estimate_relative_pose(pixels_1[None], pixels_2[None], camera_1=camera, camera_2=camera)
        if not motion.success[0]:
            return 0.0
        R_21 = motion.T_21[0, :3, :3]
    ray_1, ray_2 = camera.unproject(pixels_1) @ R_21.mT, camera.unproject(pixels_2)
    sines = torch.linalg.cross(ray_1, ray_2, dim=-1).norm(dim=-1)
    return float(torch.atan2(sines, (ray_1 * ray_2).sum(-1)).median())


def _stride(
    sequence: Sequence,
    features_of: Callable[[int], Features],
    start: int,
    steps: int,
    least: float,
    most: int,
) -> int:
    """The least of 1, 2, 4, ..., `most` with enough parallax to the frame `steps` strides later; 0 for none."""
    stride = 1
    while stride <= most and start + steps * stride < len(sequence):
        second = start + steps * stride
        T_1, T_2 = sequence.pose(start), sequence.pose(second)
        R_21 = None if T_1 is None or T_2 is None else (T_2 @ se3_inverse(T_1))[:3, :3]
        if parallax(features_of(start), features_of(second), sequence.camera, R_21) >= least:
            return stride
        stride *= 2
    return 0
