"""LightGlue as a matcher, with weights from a local file: see `features.weights`. The network is kornia's.

Source: Lindenberger, Sarlin and Pollefeys, "LightGlue: local feature matching at light speed", ICCV 2023.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from torchslam.errors import ConfigError
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
        state = renamed(read_weights(weights))
        try:
            width, self.size_in = state["input_proj.weight"].shape
            layers = len({name.split(".")[1] for name in state if name.startswith("transformers.")})
            _, positions = state["posenc.Wr.weight"].shape
        except (KeyError, ValueError):
            raise ConfigError(f"{weights}: not the weights of a LightGlue network") from None
        if not 0 < width <= MAX_WIDTH or not 0 < self.size_in <= MAX_WIDTH or not 0 < layers <= MAX_LAYERS:
            raise ConfigError(
                f"{weights}: not the weights of a LightGlue network ({layers} layers of {width} floats for "
                f"{self.size_in}; at most {MAX_LAYERS} of {MAX_WIDTH})"
            )
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
        parameters = {name for name, _ in self.network.named_parameters()}
        try:
            missing = parameters & set(self.network.load_state_dict(state, strict=False).missing_keys)
        except RuntimeError as error:  # shapes differ
            raise ConfigError(f"{weights}: the weights of another network") from error
        if missing:
            raise ConfigError(
                f"{weights}: the weights of another network ({len(missing)} tensors are missing)"
            )
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
            none = rows[0][:0][None]
            return Matches(none, none, none.float(), none.bool())
        size = torch.cat([view_1.keypoints[rows[0]], view_2.keypoints[rows[1]]]).amax(0) + 1
        if self.image_size is not None:
            size = size.new_tensor(self.image_size)
        data = {
            f"image{i}": self._data(view, at, size)
            for i, (view, at) in enumerate(zip((view_1, view_2), rows, strict=True))
        }
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
    names = {}
    for name in state:
        new = name.removeprefix(MATCHER)
        for part in ("self_attn", "cross_attn"):
            head, dot, rest = new.partition(f"{part}.")
            if not head and dot:
                layer, _, rest = rest.partition(".")
                new = f"transformers.{layer}.{part}.{rest}"
        names[name] = new
    return {new: state[name] for name, new in names.items()}
