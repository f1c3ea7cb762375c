"""Clips of sequences to learn from: chosen once, by what their images show, and read when they are asked for."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from torchslam.data.sequence import Sequence
from torchslam.errors import SequenceError
from torchslam.features import ORB, match
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse
from torchslam.learning.clip import ClipGraph, ClipSLAM
from torchslam.learning.training import seed_of
from torchslam.types import Features

MIN_MATCHES = 50
"""Between the first and the last frame of a clip: with fewer, its frames hardly show the same."""
MIN_PARALLAX = 0.05
"""Radians, three degrees, between these frames. With it the system poses 45 of 48 clips of redkitchen, machine_hall,
kitti07 and fr2_desk_20; with two degrees 3 of 8 of redkitchen, but a car shows no more than that."""
_KEYPOINTS = 500  # of the images that clips are chosen by


@dataclass(frozen=True)
class Clip:
    """T frames of a sequence, or B clips of T frames.

    images: (T, 1, H, W) or (B, T, 1, H, W) float32 in [0, 1]
    T_cw:   (T, 4, 4) or (B, T, 4, 4) float64 true poses, world to camera, metres; the identity where unknown
    known:  (T,) or (B, T) bool, where there is a true pose
    camera: params (K,) or (B, K)
    number: () or (B,) int64 in the data set that it is of
    """

    images: Tensor
    T_cw: Tensor
    known: Tensor
    camera: Camera
    number: Tensor

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
        """The frames `start`, `start + stride`, ... of a sequence.

        Raises SequenceError where it has not so many or, if `supervised`, has no true pose of one of them.
        """
        indices = range(start, start + frames * stride, stride)
        if indices[-1] >= len(sequence):
            raise SequenceError(
                f"{sequence.name}: {frames} frames from {start}, {stride} apart, lie not within its {len(sequence)}"
            )
        found = [sequence[index] for index in indices]
        known = torch.tensor([frame.T_cw_groundtruth is not None for frame in found])
        if supervised and not known.all():
            raise SequenceError(f"{sequence.name}: a frame of the clip from {start} on has no true pose")
        eye = torch.eye(4, dtype=torch.float64)
        poses = [eye if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth for frame in found]
        return cls(
            torch.cat([frame.image for frame in found]),
            torch.stack(poses),
            known,
            sequence.camera,
            torch.tensor(number),
        )

    def to(self, device: torch.device | str) -> Clip:
        """With its images on a device; geometry stays where it is."""
        return replace(self, images=self.images.to(device))


def collate(clips: Several[Clip]) -> Clip:
    """B clips, of one each, with a camera for each, as `DataLoader(collate_fn=collate)` asks for.

    Clips with and without distortion go together: no distortion is one with coefficients of zero. Raises ValueError for
    clips of different sizes or numbers of frames, and for a fisheye beside other cameras.
    """
    sizes = {tuple(clip.images.shape) for clip in clips}
    if len(sizes) > 1 or len({clip.camera.size for clip in clips}) > 1:
        raise ValueError(f"clips of a batch must have frames of one number and size, not {sorted(sizes)}")
    return Clip(
        torch.stack([clip.images for clip in clips]),
        torch.stack([clip.T_cw for clip in clips]),
        torch.stack([clip.known for clip in clips]),
        stack_cameras([clip.camera for clip in clips]),
        torch.stack([clip.number for clip in clips]),
    )


def stack_cameras(cameras: Several[Camera]) -> Camera:
    """One camera with params (B, K) of B cameras (K,) of one size; pinholes become distorted where others are."""
    models = {camera.model for camera in cameras}
    if models == {"pinhole", "radial_tangential"}:
        width = max(camera.params.shape[-1] for camera in cameras)
        padded = [torch.nn.functional.pad(c.params, (0, width - c.params.shape[-1])) for c in cameras]
        cameras = [
            Camera("radial_tangential", params, c.size) for c, params in zip(cameras, padded, strict=True)
        ]
    return Camera.stack(cameras)


def frames_in(seconds: float, sequence: Sequence) -> int:
    """Frames that make up a time, at least one."""
    return max(1, round(seconds * sequence.frame_rate))


class Clips(Dataset[Clip]):
    """Clips of sequences that move enough to show depth, in the order of sequences and time.

        clips = Clips([open_sequence("redkitchen")], per_sequence=100)
        loader = DataLoader(clips, batch_sampler=Batches(len(clips), 4), collate_fn=collate)

    A clip begins at a frame drawn at random. Its frames are 1, 2, 4, ... apart: by the least such stride with which
    matches between its first and its last frame have a parallax of `min_parallax` in the median. A start for which
    there is none before fewer than `MIN_MATCHES` match is left out. The same arguments give the same clips. Raises
    CalibrationError for a sequence without a camera, FrameError where an image to choose by cannot be read.

    frames:       of a clip
    per_sequence: at most so many clips of each sequence, beginning at different frames
    min_parallax: radians
    max_stride:   frames
    supervised:   whether every frame of a clip must have a true pose
    seed:         of the starts

    chosen:       (sequence, start, stride) of each clip
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
        self.sequences, self.frames = list(sequences), frames
        self.chosen: list[tuple[int, int, int]] = []
        generator = torch.Generator().manual_seed(seed)
        for number, sequence in enumerate(self.sequences):
            seen = _Seen(sequence)
            found: dict[int, int] = {}
            for start in torch.randperm(len(sequence), generator=generator).tolist():
                if len(found) == per_sequence:
                    break
                stride = seen.stride(start, frames - 1, min_parallax, max_stride)
                if stride and not (supervised and seen.lacks_poses(start, frames, stride)):
                    found[start] = stride
            self.chosen += [(number, start, found[start]) for start in sorted(found)]

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, number: int) -> Clip:
        """Raises FrameError where an image cannot be read."""
        sequence, start, stride = self.chosen[number]
        return Clip.of(self.sequences[sequence], start, self.frames, stride, number)


class Batches(Sampler[list[int]]):
    """Batches of a data set's numbers without end, for `DataLoader(batch_sampler=...)`; every epoch in a new order.

    Each batch is a function of its number and of the arguments alone: a training that goes on says with `first` where.

    length: of the data set; batch: clips of a batch, on each of `ranks` processes, of which this is number `rank`
    """

    def __init__(
        self, length: int, batch: int, seed: int = 0, first: int = 0, rank: int = 0, ranks: int = 1
    ) -> None:
        if length < 1 or batch < 1:
            raise ValueError(f"batches of {batch} of {length} clips are none")
        self.length, self.batch, self.seed, self.first = length, batch, seed, first
        self.rank, self.ranks = rank, ranks

    def __iter__(self) -> Iterator[list[int]]:
        epoch, order = -1, torch.empty(0)
        for number in itertools.count(self.first):
            rows = []
            begin = (number * self.ranks + self.rank) * self.batch
            for place in range(begin, begin + self.batch):
                if place // self.length != epoch:
                    epoch = place // self.length
                    generator = torch.Generator().manual_seed(seed_of(self.seed, epoch))
                    order = torch.randperm(self.length, generator=generator)
                rows.append(int(order[place % self.length]))
            yield rows


class GraphCache:
    """Graphs of the clips of a data set, each built once, by a copy of the front end as it is now.

    So what is seen of a clip does not depend on when in a training it first came: one that is resumed, with a front end
    that begins as it did, sees the same.
    """

    def __init__(self, clip_slam: ClipSLAM) -> None:
        self._clip_slam = ClipSLAM(copy.deepcopy(clip_slam.extractor), config=clip_slam.config)
        self._graphs: dict[int, ClipGraph] = {}

    def __call__(self, clips: Clip) -> ClipGraph:
        """The graph of a batch as `collate` makes it."""
        numbers = clips.number.tolist()
        for row, number in enumerate(numbers):
            if number not in self._graphs:
                self._graphs[number] = self._clip_slam.build_graph(clips.images[row], clips.camera[row])
        return ClipGraph.stack([self._graphs[number] for number in numbers])


@torch.no_grad()
def parallax(first: Features, second: Features, camera: Camera, R_21: Tensor | None = None) -> float:
    """The median angle, radians, between the rays of matches, the rotation of the camera undone.

    first, second: of one image each; R_21: (3, 3) from the first camera to the second, estimated where it is None.
    Zero where fewer than `MIN_MATCHES` match, or where nobody can tell how the camera moved.
    """
    matches = match(first, second)
    rows = matches.mask[0].nonzero().squeeze(-1)
    if len(rows) < MIN_MATCHES:
        return 0.0
    pixels_1 = first.keypoints[0, matches.indices_1[0, rows]].to(camera.params.dtype)
    pixels_2 = second.keypoints[0, matches.indices_2[0, rows]].to(camera.params.dtype)
    if R_21 is None:
        motion = estimate_relative_pose(pixels_1[None], pixels_2[None], camera, camera)
        if not motion.success[0]:
            return 0.0
        R_21 = motion.T_21[0, :3, :3]
    ray_1, ray_2 = camera.unproject(pixels_1) @ R_21.mT, camera.unproject(pixels_2)
    sines = torch.linalg.cross(ray_1, ray_2, dim=-1).norm(dim=-1)
    return float(torch.atan2(sines, (ray_1 * ray_2).sum(-1)).median())


class _Seen:
    """What there is in the frames of a sequence that clips are chosen by; every image is read once."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._orb = ORB(_KEYPOINTS)
        self._features: dict[int, Features] = {}

    def stride(self, start: int, steps: int, least: float, most: int) -> int:
        """The least of 1, 2, 4, ... `most` with which the frame `steps` strides later shows parallax; 0 for none."""
        stride = 1
        while stride <= most and start + steps * stride < len(self._sequence):
            first, second = start, start + steps * stride
            T_1, T_2 = self._sequence.pose(first), self._sequence.pose(second)
            R_21 = None if T_1 is None or T_2 is None else (T_2 @ se3_inverse(T_1))[:3, :3]
            found = parallax(self._of(first), self._of(second), self._sequence.camera, R_21)
            if found >= least:
                return stride
            stride *= 2
        return 0

    def lacks_poses(self, start: int, frames: int, stride: int) -> bool:
        return any(self._sequence.pose(start + row * stride) is None for row in range(frames))

    def _of(self, index: int) -> Features:
        if index not in self._features:
            self._features[index] = self._orb(self._sequence.image(index))
        return self._features[index]
