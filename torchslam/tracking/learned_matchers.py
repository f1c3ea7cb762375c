"""Learned matchers: LightGlue with weights from a local file, and any matcher of kornia. The networks are kornia's.

Source: Lindenberger, Sarlin and Pollefeys, "LightGlue: local feature matching at light speed", ICCV 2023.
"""

from __future__ import annotations

import re
from inspect import signature
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features.kornia_modules import BLOB_RADIUS
from torchslam.features.matching.brute_force import empty_matches, one_to_one
from torchslam.features.matching.hamming import spread_bits
from torchslam.features.weights import MATCHER, read_weights
from torchslam.types import FrameFeatures, Matches, MatchPrior

MAX_WIDTH, MAX_LAYERS = 1024, 32
"""Largest network that a file of weights may ask for; published ones have 9 layers of 256 floats."""


class LightGlue(nn.Module):
    """Matches float descriptors of the extractor that its weights were trained for; weights are its confidences.

    Args:
        weights: file of weights, or their name; the shapes determine the variant.
        image_size: width and height of the images; None: as far as the keypoints of both views reach.

    Raises:
        ConfigError: if the file cannot be read or holds another network.
    """

    weighs = True

    def __init__(self, weights: str | Path, image_size: tuple[int, int] | None = None) -> None:
        from kornia.feature import LightGlue as Network

        super().__init__()
        self.image_size = image_size
        wrong = f"{weights}: not the weights of a LightGlue network"
        state = renamed(read_weights(weights))
        try:
            width, self.size_in = state["input_proj.weight"].shape
            layers = len({name.split(".")[1] for name in state if name.startswith("transformers.")})
            _, positions = state["posenc.Wr.weight"].shape
        except (KeyError, ValueError):
            raise ConfigError(wrong) from None
        if not 0 < width <= MAX_WIDTH or not 0 < self.size_in <= MAX_WIDTH or not 0 < layers <= MAX_LAYERS:
            size = (
                f"{layers} layers of {width} floats for {self.size_in}; at most {MAX_LAYERS} of {MAX_WIDTH}"
            )
            raise ConfigError(f"{wrong} ({size})")
        self.with_angles = positions == 4
        with torch.device("cpu"):
            network = Network(
                features=None,  # type: ignore[arg-type]  # a name would download
                input_dim=self.size_in,
                descriptor_dim=width,
                n_layers=layers,
                num_heads=max(1, width // 64 if width % 64 == 0 else 1),
                add_scale_ori=self.with_angles,
            )
        self.network = network.float()
        wrong = f"{weights}: the weights of another network"
        try:
            missing = set(self.network.load_state_dict(state, strict=False).missing_keys)
        except RuntimeError as error:  # shapes differ
            raise ConfigError(wrong) from error
        missing &= {name for name, _ in self.network.named_parameters()}
        if missing:
            raise ConfigError(f"{wrong} ({len(missing)} tensors are missing)")
        self.network.eval()

    @torch.no_grad()
    def forward(
        self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
    ) -> Matches:
        """Match by descriptors and keypoints; the prior is ignored.

        Raises:
            ConfigError: if the weights are for other descriptors.
        """
        rows = [torch.nonzero(view.mask)[:, 0] for view in (view_1, view_2)]
        if min(map(len, rows)) == 0:
            return empty_matches(1, 0, view_1.mask.device)
        size = torch.cat([view_1.keypoints[rows[0]], view_2.keypoints[rows[1]]]).amax(0) + 1
        if self.image_size is not None:
            size = size.new_tensor(self.image_size)
        data = {"image0": self._data(view_1, rows[0], size), "image1": self._data(view_2, rows[1], size)}
        with size.device:  # kornia makes tensors on the default device
            found = self.network(data)
        first, second = found["matches"][0].unbind(-1)
        scores = found["scores"][0].double()
        good = scores > 0
        one, two = rows[0][first][None], rows[1][second][None]
        return Matches(one, two, (1 - scores).float()[None], good[None], weights=scores[None])

    def _data(self, view: FrameFeatures, rows: Tensor, size: Tensor) -> dict[str, Tensor]:
        described = view.descriptors[rows]
        if not described.is_floating_point() or described.shape[-1] != self.size_in:
            raise ConfigError(
                f"matcher lightglue: its weights are for descriptors of {self.size_in} floats, "
                f"these are {described.shape[-1]} x {described.dtype}"
            )
        # Projected points may lie half a pixel outside of the image, where the network takes none.
        inside = view.keypoints[rows].clamp_min(0.0).minimum(size)
        data = {
            "keypoints": inside.float()[None],
            "descriptors": described.float()[None],
            "image_size": size.float()[None],
        }
        if self.with_angles:
            data |= {"scales": view.scales[rows].float()[None], "oris": view.angles[rows].float()[None]}
        return data


def renamed(state: dict[str, Shaped[Tensor, "..."]]) -> dict[str, Shaped[Tensor, "..."]]:
    """The tensors under the current names: published files have older ones."""
    old = re.compile(r"^(self_attn|cross_attn)\.([^.]*)\.")
    return {old.sub(r"transformers.\2.\1.", name.removeprefix(MATCHER)): state[name] for name in state}


def make_kornia_matcher(kind: type[nn.Module], features: str, weights: str | None = None) -> KorniaMatcher:
    """Make the matcher of a class as kornia does by default, for the features of a name.

    Raises:
        ConfigError: kornia has no weights for these features, or a file with weights is given.
    """
    name = kind.__name__
    if weights is not None:
        raise ConfigError(f"matcher {name}: takes no weights from a file; `lightglue` does")
    if "feature_name" not in signature(kind).parameters:
        return KorniaMatcher(kind())
    modes: list[str] = cast(Any, kind).known_modes
    known = {mode.replace("_", ""): mode for mode in modes}
    mode = known.get(features.rpartition(":")[2].lower())
    if mode is None:
        trained = ", ".join(modes)
        raise ConfigError(f"matcher {name}: has no weights for the features {features!r}, but for {trained}")
    return KorniaMatcher(kind(feature_name=mode))


class KorniaMatcher(nn.Module):
    """A matcher of kornia behind torchslam's interface; the prior is ignored.

    Regions are as large and turned as the keypoints, and round. Binary descriptors become floats of their bits. Where
    several keypoints match one of the second view, the best one is kept.

    Args:
        module: takes descriptors (N1, D) and (N2, D), and regions (LAFs) of both if its arguments are called so, and
            returns distances, or scores if it is a `LightGlueMatcher`, and rows of both (M, 2).

    Raises:
        ConfigError: The module takes something else, such as images.
    """

    def __init__(self, module: nn.Module) -> None:
        from kornia.feature import LightGlueMatcher

        super().__init__()
        self.module = module.eval()
        taken = signature(module.forward).parameters
        self._takes_lafs, self._takes_sizes = "lafs1" in taken, "hw1" in taken
        if "desc1" not in taken:
            raise ConfigError(
                f"matcher {type(module).__name__}: takes {', '.join(taken)}, not the descriptors of two views"
            )
        self.weighs = isinstance(module, LightGlueMatcher)
        """LightGlue's scores are weights."""

    @torch.no_grad()
    def forward(
        self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
    ) -> Matches:
        """Match the keypoints of two views."""
        views = view_1, view_2
        rows = [torch.nonzero(view.mask)[:, 0] for view in views]
        if min(map(len, rows)) < 2:  # a ratio test needs a second neighbor
            return empty_matches(1, 0, view_1.mask.device)
        given = [_floats(view.descriptors[at]) for view, at in zip(views, rows, strict=True)]
        if self._takes_lafs:
            given += [_lafs(view, at) for view, at in zip(views, rows, strict=True)]
        sizes = {}
        if self._takes_sizes:
            # Of both as far as the keypoints of either reach: projected points may lie outside of the image.
            width, height = torch.cat([lafs[0, :, :, 2] for lafs in given[2:]]).amax(0).ceil().int().tolist()
            sizes = {"hw1": (height + 1, width + 1), "hw2": (height + 1, width + 1)}
        found, pairs = self.module(*given, **sizes)[:2]
        first, second = pairs.unbind(-1)
        found = found[:, 0].float()
        distances = 1 - found if self.weighs else found
        all_of_them = torch.ones_like(second, dtype=torch.bool)[None]
        mask = one_to_one(second[None], distances[None], all_of_them, len(rows[1]))
        matched = rows[0][first][None], rows[1][second][None], distances[None]
        if not self.weighs:
            return Matches(*matched, mask)
        return Matches(*matched, mask & (found > 0)[None], weights=found.double()[None])


def _floats(descriptors: Shaped[Tensor, "N D"]) -> Float[Tensor, "N _"]:
    """Descriptors of unit length; squared distances of binary ones are proportional to their Hamming distances."""
    if descriptors.dtype != torch.uint8:
        return descriptors.float()
    bits = spread_bits(descriptors, 1).float()
    return bits / bits.shape[-1] ** 0.5


def _lafs(view: FrameFeatures, rows: Int[Tensor, " R"]) -> Float[Tensor, "1 R 2 3"]:
    """Round regions of keypoints, as `KorniaFeatures` reads them."""
    from kornia.feature import laf_from_center_scale_ori

    keypoints, scales = view.keypoints[rows].float(), view.scales[rows].float()
    angles = view.angles[rows].float().rad2deg()
    return laf_from_center_scale_ori(
        keypoints[None].clamp_min(0.0), (BLOB_RADIUS * scales)[None, :, None, None], angles[None, :, None]
    )
