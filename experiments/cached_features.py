"""Feature extractors with features cached on disk, for many runs over the same images.

torchslam run IMAGES -o results --features experiments.cached_features:XFeat --weights xfeat.safetensors
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from torchslam.features import extractor
from torchslam.types import Features

FOLDER = Path(os.environ.get("TORCHSLAM_CACHED_FEATURES", "results/cached_features"))


class Cached(nn.Module):
    """A feature extractor of torchslam that reads cached features of known images.

    Floating-point descriptors are stored in half precision, everything else exactly.
    """

    kind = "orb"

    def __init__(self, num_keypoints: int = 1000, weights: str | None = None) -> None:
        super().__init__()
        self.extractor = extractor(self.kind, num_keypoints, weights)
        self.key = repr((self.kind, num_keypoints, Path(weights or "").name)).encode()

    def forward(self, images: Tensor, mask: Tensor | None = None) -> Features:
        """(B, 1, H, W) to features; with a mask nothing is cached."""
        if mask is not None:
            return self.extractor(images, mask)
        return Features.cat([self._of(image[None]) for image in images])

    def _of(self, image: Tensor) -> Features:
        content = self.key + repr(tuple(image.shape)).encode() + image.contiguous().numpy().tobytes()
        name = hashlib.sha256(content).hexdigest()[:32]
        path = FOLDER / name[:2] / f"{name}.pt"
        if not path.exists():
            found = self.extractor(image)
            stored = found.descriptors.half() if found.descriptors.is_floating_point() else found.descriptors
            path.parent.mkdir(parents=True, exist_ok=True)
            writing = path.with_suffix(f".{os.getpid()}")  # other processes may write the same
            torch.save(vars(replace(found, descriptors=stored)), writing)
            writing.replace(path)
        found = Features(**torch.load(path, weights_only=True))  # the stored ones, also the first time
        if not found.descriptors.is_floating_point():
            return found
        return replace(found, descriptors=nn.functional.normalize(found.descriptors.float(), dim=-1))


class ORB(Cached):
    kind = "orb"


class XFeat(Cached):
    kind = "xfeat"


class ALIKED(Cached):
    kind = "aliked"
