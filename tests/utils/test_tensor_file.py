"""Tensor files are those of safetensors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from torchslam.utils.tensor_file import TYPES, Blocks, write_tensors


def test_tensors_of_all_types_and_layouts_are_read_by_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "all.safetensors"
    tensors = {f"of {name}": torch.arange(6).reshape(2, 3).to(dtype) for dtype, name in TYPES.items()}
    tensors |= {
        "number": torch.tensor(2.5),
        "empty": torch.zeros(0, 4),
        "turned": torch.arange(6.0).reshape(2, 3).mT,
        "odd": torch.ones(3, dtype=torch.bool),
        "with graph": torch.ones(2, requires_grad=True),
    }
    write_tensors(path, tensors, {"about": "everything"})
    read = load_file(path)
    assert read.keys() == tensors.keys()
    for name, tensor in tensors.items():
        torch.testing.assert_close(read[name], tensor.detach(), rtol=0, atol=0)
    with safe_open(str(path), framework="pt") as file:
        assert file.metadata() == {"about": "everything"}


def test_blocks_follow_each_other_and_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    rows = torch.arange(10, dtype=torch.int64).reshape(5, 2)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    write_tensors(whole, {"rows": rows, "more": rows.float()}, {})
    blocks = Blocks(torch.int64, (5, 2), iter([rows[:2], rows[2:].int()]))  # of the stated type in the file
    write_tensors(parts, {"more": rows.float(), "rows": blocks}, {})
    assert whole.read_bytes() == parts.read_bytes()


def test_a_file_stays_as_it_was_if_a_block_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_tensors(path, {"rows": torch.ones(3)}, {})
    before = path.read_bytes()

    def rows():
        yield torch.zeros(1)
        raise OSError("damaged")

    with pytest.raises(OSError, match="damaged"):
        write_tensors(path, {"rows": Blocks(torch.float32, (3,), rows())}, {})
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
