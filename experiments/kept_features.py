"""Front ends by name whose features are kept on disk: many runs over the same images need them found once.

torchslam run IMAGES -o results --features experiments.kept_features:XFeat --weights xfeat.safetensors
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

FOLDER = Path(os.environ.get("TORCHSLAM_KEPT_FEATURES", "results/kept_features"))


class Kept(nn.Module):
    """One of torchslam's front ends, which reads what it found in an image before.

    Descriptors of floats are kept in half precision, all else as it is: with bits the same as without keeping.
    """

    kind = "orb"

    def __init__(self, num_keypoints: int = 1000, weights: str | None = None) -> None:
        super().__init__()
        self.front_end = extractor(self.kind, num_keypoints, weights)
        self.words = repr((self.kind, num_keypoints, Path(weights or "").name)).encode()

    def forward(self, images: Tensor, wanted: Tensor | None = None) -> Features:
        """(B, 1, H, W) to features; with a mask nothing is kept."""
        if wanted is not None:
            return self.front_end(images, wanted)
        return Features.cat([self._of(image[None]) for image in images])

    def _of(self, image: Tensor) -> Features:
        said = self.words + repr(tuple(image.shape)).encode() + image.contiguous().numpy().tobytes()
        name = hashlib.sha256(said).hexdigest()[:32]
        path = FOLDER / name[:2] / f"{name}.pt"
        if not path.exists():
            found = self.front_end(image)
            kept = found.descriptors.half() if found.descriptors.is_floating_point() else found.descriptors
            path.parent.mkdir(parents=True, exist_ok=True)
            writing = path.with_suffix(f".{os.getpid()}")  # several processes may find the same
            torch.save(vars(replace(found, descriptors=kept)), writing)
            writing.replace(path)
        found = Features(**torch.load(path, weights_only=True))  # what was kept, also the first time
        if not found.descriptors.is_floating_point():
            return found
        return replace(found, descriptors=nn.functional.normalize(found.descriptors.float(), dim=-1))


class ORB(Kept):
    kind = "orb"


class XFeat(Kept):
    kind = "xfeat"


class ALIKED(Kept):
    kind = "aliked"
