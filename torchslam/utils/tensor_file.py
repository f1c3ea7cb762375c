"""Files in the format of safetensors, written in pieces: its own writer holds the content of a file twice."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchslam.utils.files import write_whole

TYPES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
"""The names of types of numbers in such a file."""


class Blocks(NamedTuple):
    """A tensor of a file, whose rows come in blocks, when they are written."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    rows: Iterable[Tensor]


def write_tensors(
    path: str | Path, tensors: Mapping[str, Tensor | Blocks], metadata: Mapping[str, str]
) -> None:
    """Write named tensors and metadata, atomically; equal content gives equal bytes."""
    blocks = {
        name: each if isinstance(each, Blocks) else Blocks(each.dtype, tuple(each.shape), [each])
        for name, each in tensors.items()
    }
    # Wide types first, so that every tensor begins at a multiple of its item size.
    names = sorted(blocks, key=lambda name: (-blocks[name].dtype.itemsize, name))
    header: dict[str, Any] = {"__metadata__": dict(metadata)}
    end = 0
    for name in names:
        dtype, shape, _ = blocks[name]
        start, end = end, end + dtype.itemsize * torch.Size(shape).numel()
        header[name] = {"dtype": TYPES[dtype], "shape": list(shape), "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)

    def content() -> Iterable[bytes | memoryview]:
        yield struct.pack("<Q", len(text)) + text
        for name in names:
            for block in blocks[name].rows:
                rows = block.detach().to("cpu", blocks[name].dtype).contiguous()
                yield rows.view(-1).view(torch.uint8).numpy().data if rows.numel() else b""

    write_whole(path, content())
