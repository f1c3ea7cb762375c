"""Learned features behind the same interface as `ORB`, with weights from a local file: see `features.weights`.

The networks are kornia's. Descriptors are floats of unit length, angles are 0. All keypoints have the scale 2 pixels,
and their information is that of the noise measured on real sequences (docs/studies.md).
Keypoints, scores and descriptors carry gradients to the weights.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features.contract import apply_mask, check_images
from torchslam.features.corners import soft_peak
from torchslam.features.weights import EXTRACTOR, MATCHER, read_weights
from torchslam.geometry.precision import without_autocast
from torchslam.types import Features

_SCALE = 2.0
"""Scale of all keypoints of a network, which finds none, pixels; the noise is in `information`.
Tried at this value only."""
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
        with torch.device("cpu"):
            model = kornia.feature.XFeat().float()
        # The file may leave out the fine matcher, which only dense matching needs.
        state = {_XFEAT_PREFIX.sub("net.", name): tensor for name, tensor in read_weights(weights).items()}
        state = {name: tensor for name, tensor in state.items() if not name.startswith("net.matcher.")}
        _load(model, state, weights, optional="net.fine_matcher.")
        self.network = model.net.eval()
        self.network.keypoint_head = _FullPrecision(*self.network.keypoint_head)

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints; arguments, result and errors as for `ORB.forward`."""
        from kornia.geometry.subpix import nms2d

        check_images(images, mask)
        coarse, heat, scores = self._maps(images)
        peaks = nms2d(heat.detach()[:, None], (5, 5), mask_only=True)[:, 0] & (heat > self.threshold)
        inner = heat.shape[1:]
        if mask is not None:
            peaks &= F.interpolate(mask.float(), inner, mode="nearest-exact")[:, 0] > 0
        ranked = torch.where(peaks, scores, 0).flatten(1)
        best = ranked.detach().topk(min(self.num_keypoints, ranked.shape[1]))
        places = torch.stack((best.indices % inner[1], best.indices // inner[1]), dim=-1)
        return self._features(images, coarse, heat, scores, places, best.values > 0)

    def read(
        self, images: Float[Tensor, "B 1 H W"], keypoints: Float[Tensor, "B N 2"], mask: Bool[Tensor, "B N"]
    ) -> Features:
        """Describe keypoints found before in these images, in the same rows, whatever their scores are now.

        Each keypoint of the mask is located anew around the peak that is at most one pixel of the network's input away.
        """
        check_images(images)
        coarse, heat, scores = self._maps(images)
        positions = (keypoints.to(heat) + 0.5) / _ratio(images, heat) - 0.5
        return self._features(images, coarse, heat, scores, _peaks_near(heat, positions), mask)

    def _maps(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Descriptors (B, 64, h, w), and the heat map and the scores (B, H', W'), in float32 also under autocast."""
        height, width = images.shape[-2:]
        # The network halves its input five times.
        inner = (max(32, height // 32 * 32), max(32, width // 32 * 32))
        resized = F.interpolate(images.float(), inner, mode="bilinear", align_corners=False)
        coarse, logits, reliability = (each.float() for each in self.network(resized))
        # 64 places of a cell of 8x8 pixels, row by row, and one for "no keypoint here".
        heat = F.pixel_shuffle(logits.softmax(1)[:, :64], 8)
        scores = heat * F.interpolate(reliability, inner, mode="bilinear", align_corners=False)
        return coarse, heat[:, 0], scores[:, 0]

    @without_autocast
    def _features(
        self, images: Tensor, coarse: Tensor, heat: Tensor, scores: Tensor, places: Tensor, found: Tensor
    ) -> Features:
        """Features at places (B, N, 2) of the heat map, padded to `num_keypoints` rows."""
        positions = places + soft_peak(_windows(heat, places).flatten(0, 1)).view(places.shape)
        # Pixels from 0 to W - 1 span the coarse map from edge to edge: so the network was trained.
        grid = 2 * positions / positions.new_tensor([heat.shape[2] - 1, heat.shape[1] - 1]) - 1
        sampled = F.grid_sample(
            F.normalize(coarse, dim=1), grid[:, None], mode="bicubic", align_corners=False
        )
        descriptors = F.normalize(sampled[:, :, 0].mT, dim=-1)
        keypoints = (positions + 0.5) * _ratio(images, heat) - 0.5
        scores = scores[_image_index(places), places[..., 1], places[..., 0]]
        count = max(self.num_keypoints, found.shape[1])
        return _features(keypoints, scores, descriptors, found, count, XFEAT_NOISE)


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
        names = ("block1.conv1.weight", "desc_head.agg_weights")
        shape = tuple(len(state[name]) for name in names if name in state and state[name].ndim)
        if shape not in variants:
            raise ConfigError(f"{weights}: not the weights of an ALIKED network")
        # Without a threshold the network gives its strongest maxima.
        with torch.device("cpu"):
            network = kornia.feature.ALIKED(variants[shape], num_keypoints, detection_threshold=0)
        self.network = network.float()
        _load(self.network, state, weights, optional="dkd.")  # the detector's grid of pixels is no weight
        self.network.eval()

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints; arguments, result and errors as for `ORB.forward`.

        The detector of the network has no mask, so keypoints elsewhere are dropped, not replaced.
        """
        check_images(images, mask)
        with images.device:  # kornia makes tensors on the default device
            found = self.network(images.float())
        rows = []
        for one in found:
            keypoints, scores, descriptors = (
                one.keypoints[None],
                one.keypoint_scores[None],
                one.descriptors[None],
            )
            mask_1 = torch.ones_like(scores, dtype=torch.bool)
            rows.append(
                _features(keypoints, scores, descriptors.float(), mask_1, self.num_keypoints, ALIKED_NOISE)
            )
        features = Features.cat(rows)
        return features if mask is None else apply_mask(features, mask)

    def read(
        self, images: Float[Tensor, "B 1 H W"], keypoints: Float[Tensor, "B N 2"], mask: Bool[Tensor, "B N"]
    ) -> Features:
        """Describe keypoints found before, in the same rows, whatever their scores are now; as `XFeat.read`."""
        check_images(images)
        with images.device:
            maps, heat = self.network.extract_dense_map(images.float().expand(-1, 3, -1, -1))
        places = _peaks_near(heat[:, 0].float(), keypoints.to(torch.float32))
        located, scores = self._located(heat, places)
        with images.device:
            descriptors, _ = self.network.desc_head(maps, list(located))
        size = located.new_tensor([images.shape[3] - 1, images.shape[2] - 1])
        return _features(
            size * (located + 1) / 2,
            scores,
            torch.stack([each.to(located) for each in descriptors]),
            mask,
            max(self.num_keypoints, mask.shape[1]),
            ALIKED_NOISE,
        )

    @without_autocast
    def _located(self, heat: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (B, N, 2), from -1 to 1 over the image, and scores (B, N), as the network's detector has them."""
        detector, heat = self.network.dkd, heat.float()
        weights = torch.softmax(_windows(heat[:, 0], places).flatten(2) / detector.temperature, dim=-1)
        positions = places + weights @ torch.as_tensor(detector.hw_grid, device=weights.device)
        located = positions / positions.new_tensor([heat.shape[3] - 1, heat.shape[2] - 1]) * 2 - 1
        scores = F.grid_sample(heat, located[:, None], mode="bilinear", align_corners=True)
        return located, scores[:, 0, 0]


class _FullPrecision(nn.Sequential):
    """Layers in the precision of their parameters also under autocast: a rounded logit moves its keypoint."""

    forward = without_autocast(nn.Sequential.forward)


def _image_index(places: Int[Tensor, "B N 2"]) -> Int[Tensor, "B N"]:
    return torch.arange(len(places), device=places.device)[:, None].expand(places.shape[:2])


def _windows(heat: Float[Tensor, "B H W"], places: Int[Tensor, "B N 2"]) -> Float[Tensor, "B N 5 5"]:
    """The map around places (x, y), zero beyond its edge."""
    windows = F.pad(heat, (2,) * 4).unfold(1, 5, 1).unfold(2, 5, 1)
    return windows[_image_index(places), places[..., 1], places[..., 0]]


def _peaks_near(heat: Float[Tensor, "B H W"], positions: Float[Tensor, "B N 2"]) -> Int[Tensor, "B N 2"]:
    """The place (x, y) of the largest value within one pixel: from where a soft peak was located, that of the peak."""
    most = torch.tensor([heat.shape[2] - 1, heat.shape[1] - 1], device=heat.device)
    places = torch.minimum(positions.detach().round().long().clamp_min(0), most)
    near = _windows(heat.detach(), places)[..., 1:-1, 1:-1].flatten(-2).argmax(-1)
    return torch.minimum((places + torch.stack((near % 3, near // 3), dim=-1) - 1).clamp_min(0), most)


def _ratio(images: Tensor, heat: Float[Tensor, "B H W"]) -> Float[Tensor, " 2"]:
    """Pixels of the images per pixel of the map, along x and y."""
    return heat.new_tensor([images.shape[3] / heat.shape[2], images.shape[2] / heat.shape[1]])


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
