"""Freed memory is used again, and goes back to the system where a stage asks for it."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only glibc, of Linux, can be told so"
)
RESIDENT = """
import os, sys
import torch
from torchslam.utils.memory import keep_freed_memory, return_freed_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

kept = keep_freed_memory() if sys.argv[1] == "kept" else False
"""


def returned(code: str, how: str = "kept") -> int:
    """Bytes that go back to the system, as a program prints them."""
    words = [sys.executable, "-c", RESIDENT + code, how]
    kept, count = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    if how == "kept" and kept == "False":
        pytest.skip("the C library is not glibc")
    return int(count)


def test_memory_of_a_tensor_is_kept() -> None:
    code = """
tensor = torch.ones(24 << 20, dtype=torch.uint8)
before = resident()
del tensor
print(kept, before - resident())
"""
    assert returned(code) < 4 << 20
    assert returned(code, "as it is") > 20 << 20


def test_memory_between_tensors_in_use_goes_back() -> None:
    """The tensors that stay are small, and lie between those that are freed."""
    code = """
stay, go = [], []
for _ in range(400):
    go.append(torch.ones(1 << 18, dtype=torch.uint8))
    stay.append(torch.ones(64))
del go
before = resident()
return_freed_memory()
print(kept, before - resident())
"""
    assert returned(code) > 80 << 20
