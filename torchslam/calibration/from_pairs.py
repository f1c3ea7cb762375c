"""The focal length of an unknown camera from pairs of images, before anything is mapped, within a bounded time.

Fundamental matrices of images at several distances in time, around places spread over the recording, need no camera;
the focal length turns them into essential matrices (`geometry.view_graph_focal`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.geometry import Camera
from torchslam.geometry.view_graph_focal import ViewGraphFocal, focal_from_pairs
from torchslam.system.front_end import Extractor, image_extractor
from torchslam.tracking.data_association import match_views
from torchslam.types import FrameFeatures

PLACES = 20
"""Places of the recording at which images are matched; about the number from which the focal length is stable."""
OFFSETS = 0, 2, 5, 12, 30
"""Images of a place, in frames from its first: some pairs have a parallax at any speed and frame rate."""
NUM_KEYPOINTS = 1500
"""SIFT keypoints of an image, for matches between images 30 frames apart. Tried at this value only."""
THRESHOLD_PX = 1.0
"""Distance from the epipolar line; as fundamental matrices of SIFT are usually estimated."""
CONFIDENCE, MAX_SAMPLES = 0.9999, 2000
"""Of MAGSAC, and its largest number of samples. Tried at these values only."""
MIN_MATCHES = 40
"""Matches that agree with a fundamental matrix: its noise is known then."""
MAX_PAIRS = 100
"""Pairs that are used, those furthest apart in time first: they have most parallax."""


def search_focal(
    sequence: Sequence,
    config: Config,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, most: None,
    extract: Extractor | None = None,
) -> ViewGraphFocal | None:
    """Find the focal length by pairs of images; unreadable images are left out, the run itself reports them.

    Args:
        sequence: with a guessed camera, of which the principal point and fy / fx are used.
        config: of the run.
        device: of torch.
        progress: called with the number of images done, and of all.
        extract: extracts SIFT features of an image, at least `NUM_KEYPOINTS`, the strongest first; None: SIFT with
            this number.

    Returns:
        fx with its standard error, and `success` if the pairs determine it; None if no two images could be matched.
    """
    settings = replace(config.features, kind="sift", num_keypoints=NUM_KEYPOINTS)
    config = replace(config, features=settings)
    if sequence.brings_features:
        extract = None
    elif extract is None:
        extract = image_extractor(config, device)
    last = max(len(sequence) - 1 - OFFSETS[-1], 0)
    starts = sorted({round(last * place / max(PLACES - 1, 1)) for place in range(PLACES)})
    wanted = sorted(
        {start + offset for start in starts for offset in OFFSETS if start + offset < len(sequence)}
    )
    views: dict[int, FrameFeatures] = {}
    for done, index in enumerate(wanted):
        progress(done, len(wanted))
        try:
            frame = sequence[index]
        except FrameError:
            continue
        with torch.inference_mode():
            features = frame.features if extract is None else extract(frame)
        assert features is not None
        if extract is not None:
            features = features.rows(slice(NUM_KEYPOINTS))
        views[index] = FrameFeatures.of(frame, features, sequence.camera.params.double())
    matched: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor] | None] = {}
    scale = config.features.reduction(sequence.camera.size)
    for start in starts:
        around = [start + offset for offset in OFFSETS if start + offset in views]
        for one, other in combinations(around, 2):
            if (one, other) not in matched:
                matched[one, other] = _fundamental(views[one], views[other], config, scale)
    widest = sorted(matched, key=lambda pair: pair[0] - pair[1])
    chosen = [pair for pair in (matched[ends] for ends in widest) if pair is not None][:MAX_PAIRS]
    return _solve(chosen, sequence.camera, scale) if chosen else None


def _fundamental(
    one: FrameFeatures, other: FrameFeatures, config: Config, scale: float
) -> tuple[Tensor, Tensor, Tensor] | None:
    """F (3, 3) and the matches (M, 2) of either image that agree with it; None if there are too few."""
    at_1, at_2 = match_views(one, other, config.matching)
    if len(at_1) < MIN_MATCHES:
        return None
    pixels_1, pixels_2 = one.keypoints[at_1].cpu(), other.keypoints[at_2].cpu()
    try:
        F, mask = cv2.findFundamentalMat(
            pixels_1.numpy(), pixels_2.numpy(), cv2.USAC_MAGSAC, THRESHOLD_PX * scale, CONFIDENCE, MAX_SAMPLES
        )
    except cv2.error:  # OpenCV raises for some degenerate matches
        return None
    if F is None or F.shape != (3, 3) or np.count_nonzero(mask) < MIN_MATCHES:
        return None
    agreeing = torch.from_numpy(mask[:, 0] > 0)
    return torch.from_numpy(F), pixels_1[agreeing], pixels_2[agreeing]


def _solve(pairs: list[tuple[Tensor, Tensor, Tensor]], camera: Camera, scale: float) -> ViewGraphFocal:
    """fx by all pairs, in images that are scaled in height so that their pixels are square."""
    ratio = float(camera.fx / camera.fy)
    stretch = torch.tensor([1.0, ratio, 1.0], dtype=torch.float64, device="cpu")
    F = torch.stack([pair[0] for pair in pairs]).double() / (stretch[:, None] * stretch)
    pixels_1, pixels_2 = (
        torch.nn.utils.rnn.pad_sequence([pair[side] for pair in pairs], batch_first=True).double()
        * stretch[:2]
        for side in (1, 2)
    )
    mask = torch.nn.utils.rnn.pad_sequence(
        [torch.ones(len(pair[1]), dtype=torch.bool, device="cpu") for pair in pairs], batch_first=True
    )
    return focal_from_pairs(
        F,
        pixels_1,
        pixels_2,
        mask,
        camera.params[2:4].detach().cpu().double() * stretch[:2],
        (camera.width, round(camera.height * float(stretch[1]))),
        threshold=THRESHOLD_PX * scale,
    )
