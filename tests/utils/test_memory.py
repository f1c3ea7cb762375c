"""Freed memory is used again."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import resource, sys
import torch
from torchslam.utils.memory import keep_freed_memory

kept = keep_freed_memory() if sys.argv[1] == "kept" else False
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    parts = [torch.zeros(24 << 20, dtype=torch.uint8) for _ in range(3)]
    del parts
print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def pages(how: str) -> tuple[str, int]:
    words = [sys.executable, "-c", CODE, how]
    kept, count = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    return kept, int(count)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only glibc, of Linux, can be told so")
def test_tensors_that_follow_each_other_use_the_same_pages() -> None:
    kept, count = pages("kept")
    if kept == "False":
        pytest.skip("the C library is not glibc")
    _, without = pages("as it is")
    assert count < without / 3


def test_memory_between_tensors_in_use_goes_back() -> None:
    """The tensors that stay are small, and lie between those that are freed."""
    code = """
import os
import torch
from torchslam.utils.memory import keep_freed_memory, return_freed_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

kept = keep_freed_memory()
stay, go = [], []
for _ in range(400):
    go.append(torch.ones(1 << 18, dtype=torch.uint8))
    stay.append(torch.ones(64))
del go
before = resident()
return_freed_memory()
print(kept, before - resident())
"""
    if not sys.platform.startswith("linux"):
        pytest.skip("only glibc, of Linux, can be told so")
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    kept, returned = run.stdout.split()
    if kept == "False":
        pytest.skip("the C library is not glibc")
    assert int(returned) > 80 << 20
