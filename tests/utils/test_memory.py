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
for size in 4 * [20, 24, 28] + 8 * [31]:
    parts = [torch.zeros(size << 20, dtype=torch.uint8) for _ in range(3)]
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
