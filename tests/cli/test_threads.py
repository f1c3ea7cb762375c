"""A command leaves no thread behind: one that still runs while the interpreter exits may end it with a crash."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import write_tum_folder


@pytest.mark.parametrize("processes", [pytest.param("1", marks=pytest.mark.slow), "3"])
@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted on Linux")
def test_a_run_has_one_thread_when_it_ends(tmp_path: Path, processes: str) -> None:
    code = (
        "import os, sys; from torchslam.cli.main import main; status = main(sys.argv[1:]); "
        "print(len(os.listdir('/proc/self/task'))); sys.exit(status)"
    )
    folder = write_tum_folder(tmp_path / "images", frames=8)
    arguments = ["run", str(folder), "--features", "opencv-orb", "-o", str(tmp_path / "out")]
    unset = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    command = [sys.executable, "-c", code, *arguments, "--processes", processes]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=unset)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "1"
