"""Learned features behind the same interface as `ORB`, with weights from a local file: see `features.weights`.

The networks are kornia's. Descriptors are floats of unit length, angles are 0. All keypoints have the scale 2 pixels,
and their information is that of the noise measured on real sequences (`experiments/front_ends/noise.py`).
Keypoints, scores and descriptors carry gradients to the weights.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features.contract import apply_mask
from torchslam.features.corners import soft_peak
from torchslam.features.orb import check_images
from torchslam.features.weights import EXTRACTOR, MATCHER, read_weights
from torchslam.types import Features

_SCALE = 2.0
_XFEAT_PREFIX = re.compile(r"^(extractor\.model\.)?(net\.)?")  # published files have none, one or both
XFEAT_NOISE, ALIKED_NOISE = 1.0, 0.7
"""Standard deviations of keypoints, in pixels of the network's input, measured in whole runs on real sequences: XFeat
has 1.03 to 1.35 (with 1.2, a short sequence is not initialized), ALIKED 0.5 to 0.8."""


class XFeat(nn.Module):
    """XFeat: 64 floats per keypoint (Potje et al., CVPR 2024).

    Args:
        weights: file of the network's weights, or their name.
        num_keypoints: largest number of keypoints per image; rows beyond what the image offers are masked.
        threshold: of the keypoint heat map, 0 to 1.

    Raises:
        ConfigError: The file cannot be read or holds another network.
    """

    def __init__(self, weights: str | Path, num_keypoints: int = 1000, threshold: float = 0.05) -> None:
        import kornia  # here, as the import is slow and only the networks need it

        super().__init__()
        self.num_keypoints = num_keypoints
        self.threshold = threshold
        model = kornia.feature.XFeat()
        # The file may leave out the fine matcher, which only dense matching needs.
        state = {_XFEAT_PREFIX.sub("net.", name): tensor for name, tensor in read_weights(weights).items()}
        state = {name: tensor for name, tensor in state.items() if not name.startswith("net.matcher.")}
        _load(model, state, weights, optional="net.fine_matcher.")
        self.network = model.net.eval()

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints.

        Args:
            images: gray, in [0, 1].
            mask: where keypoints may lie; None: everywhere.

        Returns:
            Features with N = num_keypoints rows, in order of falling score, masked ones last.

        Raises:
            ValueError: The images or the mask have another shape or type.
        """
        from kornia.geometry.subpix import nms2d

        check_images(images, mask)
        height, width = images.shape[-2:]
        # The network halves its input five times.
        inner = (max(32, height // 32 * 32), max(32, width // 32 * 32))
        resized = F.interpolate(images.float(), inner, mode="bilinear", align_corners=False)
        coarse, logits, reliability = self.network(resized)
        # 64 places of a cell of 8x8 pixels, row by row, and one for "no keypoint here".
        heat = F.pixel_shuffle(logits.softmax(1)[:, :64], 8)
        scores = heat * F.interpolate(reliability, inner, mode="bilinear", align_corners=False)
        peaks = nms2d(heat.detach(), (5, 5), mask_only=True) & (heat > self.threshold)
        if mask is not None:
            peaks &= F.interpolate(mask.float(), inner, mode="nearest-exact") > 0
        ranked = torch.where(peaks, scores, 0).flatten(1)
        best = ranked.detach().topk(min(self.num_keypoints, ranked.shape[1]))
        found = best.values > 0
        x, y = best.indices % inner[1], best.indices // inner[1]

        windows = F.pad(heat[:, 0], (2, 2, 2, 2)).unfold(1, 5, 1).unfold(2, 5, 1)
        image = torch.arange(len(images), device=images.device)[:, None].expand_as(x)
        offsets = soft_peak(windows[image, y, x].flatten(0, 1))
        positions = torch.stack([x, y], dim=-1) + offsets.view(*x.shape, 2)
        # Pixels from 0 to W - 1 span the coarse map from edge to edge: so the network was trained.
        grid = 2 * positions / positions.new_tensor([inner[1] - 1, inner[0] - 1]) - 1
        sampled = F.grid_sample(
            F.normalize(coarse, dim=1),
            grid[:, None],
            mode="bicubic",
            padding_mode="zeros",
            align_corners=False,
        )
        descriptors = F.normalize(sampled[:, :, 0].mT, dim=-1)
        ratio = positions.new_tensor([width / inner[1], height / inner[0]])
        keypoints = (positions + 0.5) * ratio - 0.5
        scores = ranked.gather(1, best.indices)
        return _features(keypoints, scores, descriptors, found, self.num_keypoints, XFEAT_NOISE)


class ALIKED(nn.Module):
    """ALIKED: 64 (t16) or 128 (n16, n32) floats per keypoint (Zhao et al., IEEE TIM 2023).

    Args:
        weights: file of the network's weights, or their name; the shapes determine the variant.
        num_keypoints: largest number of keypoints per image; rows beyond what the image offers are masked.

    Raises:
        ConfigError: The file cannot be read or holds another network.
    """

    def __init__(self, weights: str | Path, num_keypoints: int = 1000) -> None:
        import kornia

        super().__init__()
        self.num_keypoints = num_keypoints
        state = {name.removeprefix(EXTRACTOR): tensor for name, tensor in read_weights(weights).items()}
        state = {name: tensor for name, tensor in state.items() if not name.startswith(MATCHER)}
        variants = {(8, 16): "aliked-t16", (16, 16): "aliked-n16", (16, 32): "aliked-n32"}
        sizes = [
            state[name].shape[:1]
            for name in ("block1.conv1.weight", "desc_head.agg_weights")
            if name in state
        ]
        shape = tuple(length for size in sizes for length in size)
        if shape not in variants:
            raise ConfigError(f"{weights}: not the weights of an ALIKED network")
        # Without a threshold the network gives its strongest maxima.
        self.network = kornia.feature.ALIKED(variants[shape], num_keypoints, detection_threshold=0)
        _load(self.network, state, weights, optional="dkd.")  # the detector's grid of pixels is no weight
        self.network.eval()

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints.

        Args:
            images: gray, in [0, 1].
            mask: where keypoints may lie; None: everywhere. The detector of the network has no mask, so keypoints
                elsewhere are dropped, not replaced.

        Returns:
            Features with N = num_keypoints rows, in order of falling score, masked ones last.

        Raises:
            ValueError: The images or the mask have another shape or type.
        """
        check_images(images, mask)
        found = self.network(images.float())
        rows = [
            _features(
                one.keypoints[None],
                one.keypoint_scores[None],
                one.descriptors[None],
                torch.ones_like(one.keypoint_scores[None], dtype=torch.bool),
                self.num_keypoints,
                ALIKED_NOISE,
            )
            for one in found
        ]
        features = Features.cat(rows)
        return features if mask is None else apply_mask(features, mask)


def _features(
    keypoints: Float[Tensor, "B R 2"],
    scores: Float[Tensor, "B R"],
    descriptors: Float[Tensor, "B R D"],
    mask: Bool[Tensor, "B R"],
    count: int,
    noise_px: float,
) -> Features:
    """Features padded to `count` rows, zero where masked, with one scale, angle 0 and one noise."""
    missing = count - mask.shape[1]
    mask = F.pad(mask, (0, missing))
    scores = F.pad(scores, (0, missing)) * mask
    keypoints, descriptors = (
        F.pad(t, (0, 0, 0, missing)) * mask[..., None] for t in (keypoints, descriptors)
    )
    scales, information = torch.full_like(scores, _SCALE), torch.full_like(scores, noise_px**-2)
    return Features(keypoints, scores, scales, torch.zeros_like(scores), descriptors, mask, information)


def _load(network: nn.Module, state: dict[str, Tensor], weights: str | Path, optional: str) -> None:
    """Fill the network; every tensor must be there but those whose name starts with `optional`."""
    try:
        missing, unexpected = network.load_state_dict(state, strict=False)
    except RuntimeError as error:  # shapes differ
        raise ConfigError(f"{weights}: the weights of another network") from error
    missing = [name for name in missing if not name.startswith(optional)]
    if missing or unexpected:
        wrong = f"{len(missing)} tensors are missing, {len(unexpected)} unknown"
        raise ConfigError(f"{weights}: the weights of another network ({wrong})")
