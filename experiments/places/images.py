"""The images that places are recognized in, their features, and which pairs of them show the same place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.common import DATA_DIR, place_of
from torchslam.data import open_sequence
from torchslam.data.formats.image_file import read_gray
from torchslam.features import ORB
from torchslam.geometry import se3_inverse, so3_log
from torchslam.types import Features

# Name: (what is opened, every how many frames). The last three share no place with anything and only distract.
SEQUENCES = {
    "redkitchen": ("redkitchen", 10),
    "machine_hall": ("machine_hall", 4),
    "room": ("synthetic:room?frames=320", 8),
    "kitti07": ("kitti07", 2),
    "fr2_desk_20": ("fr2_desk_20", 2),
    "shelf_bin": ("shelf_bin", 5),
}
MEASURED = ("redkitchen", "machine_hall", "room")
LOOKALIKE_IMAGES = 84
LOOKALIKE_GAP = 20  # pairs of one walk that are closer in time are not evaluated
GAP = 10  # the same for frames of a sequence, as they are thinned out here
NEAR_M, NEAR_DEG = 0.4, 25.0  # the same place
FAR_M, FAR_DEG = 1.5, 60.0  # certainly another view; pairs in between count neither way


@dataclass(frozen=True)
class Collection:
    """All images of all sequences, one after another: features (N, ...), and per sequence the range of its images."""

    features: Features
    ranges: dict[str, range]
    T_cw: dict[str, Tensor]


def collect() -> Collection:
    """Extract ORB features from all images, that of the lookalikes first."""
    orb = ORB(1000)
    folder = DATA_DIR / "lookalike" / "images"
    files = [folder / f"{number:03d}.jpg" for number in range(1, LOOKALIKE_IMAGES + 1)]
    found = [orb(read_gray(file, file.name)) for file in files]
    ranges, T_cw = {"lookalike": range(len(found))}, {}
    for name, (path, stride) in SEQUENCES.items():
        sequence = open_sequence(place_of(path), stride=stride)
        start = len(found)
        found += [orb(frame.image) for frame in sequence]
        ranges[name] = range(start, len(found))
        T_cw[name] = torch.stack([frame_pose(sequence.pose(index)) for index in range(len(sequence))])
    return Collection(Features.cat(found), ranges, T_cw)


def frame_pose(pose: Tensor | None) -> Tensor:
    """A true pose; NaN, which is near and far from nothing, where it is unknown."""
    return torch.full((4, 4), torch.nan, dtype=torch.float64) if pose is None else pose


def lookalike_truth() -> tuple[Tensor, Tensor]:
    """Two (84, 84) masks: the pairs of the same place, and all evaluated pairs; later image first."""
    same = torch.zeros(LOOKALIKE_IMAGES, LOOKALIKE_IMAGES, dtype=torch.bool)
    for line in (DATA_DIR / "lookalike" / "pairs.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            later, earlier = (int(name.removesuffix(".jpg")) - 1 for name in line.split())
            same[later, earlier] = True
    number = torch.arange(LOOKALIKE_IMAGES)
    return same, number[:, None] - number >= LOOKALIKE_GAP


def sequence_truth(T_cw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Three (n, n) masks: pairs of the same place, of certainly different views, and of neighbors in time."""
    centers = se3_inverse(T_cw)[:, :3, 3]
    distance = torch.cdist(centers, centers)
    R = T_cw[:, :3, :3]
    angle = torch.rad2deg(torch.linalg.vector_norm(so3_log(R[:, None] @ R.mT), dim=-1))
    number = torch.arange(len(T_cw))
    neighbors = (number[:, None] - number).abs() < GAP
    same = (distance < NEAR_M) & (angle < NEAR_DEG) & ~neighbors
    return same, ((distance > FAR_M) | (angle > FAR_DEG)) & ~neighbors, neighbors
