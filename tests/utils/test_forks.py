"""A fork opens files anew: the handles that it inherits are those of its parent."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from tests.data.mp4 import write_mp4

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Forty frames, each of its own brightness, large enough for FFmpeg to decode them in threads."""
    path = tmp_path / "clip.mp4"
    write_mp4(path, [np.full((240, 320, 3), 6 * index, np.uint8) for index in range(40)])
    return path


def run(script: str, *arguments: object) -> str:
    """What a script prints, in a process of its own: one that hangs would take pytest with it."""
    command = [sys.executable, "-c", textwrap.dedent(script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=40)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_video_is_read_by_the_workers_of_a_data_loader(clip: Path) -> None:
    printed = run(
        """
        import sys
        from torch.utils.data import DataLoader, Dataset
        from torchslam.data import open_sequence

        class Frames(Dataset):
            def __init__(self, sequence):
                self.sequence = sequence
                self.sequence.image(20)  # the decoder is in the middle of the file

            def __len__(self):
                return len(self.sequence)

            def __getitem__(self, index):
                return self.sequence.image(index)

        frames = Frames(open_sequence(sys.argv[1], "60,60,160,120"))
        for workers in (2,):
            loaded = DataLoader(frames, batch_size=None, num_workers=workers, multiprocessing_context="fork")
            print([float(image.sum()) for image in loaded])
        print([float(frames[index].sum()) for index in range(40)])
        """,
        clip,
    )
    by_two, own = printed.splitlines()
    assert by_two == own
    assert len(set(own.split())) > 38


def test_a_fork_that_drops_a_video_and_ends_does_not_wait_for_its_decoder(clip: Path) -> None:
    printed = run(
        """
        import gc, os, sys
        from torchslam.data import open_sequence

        sequence = open_sequence(sys.argv[1], "60,60,160,120")
        if os.fork() == 0:
            del sequence
            gc.collect()
            sys.exit()  # with all that a process does at its end
        _, status = os.wait()
        print(status, round(float(sequence.image(7).mean()) * 255 / 6))
        """,
        clip,
    )
    assert printed.split() == ["0", "7"]


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")
def test_decoders_are_closed_for_a_fork_and_opened_again(clip: Path) -> None:
    printed = run(
        """
        import os, sys, cv2
        from torchslam.data import open_sequence
        from torchslam.utils.forks import close_decoders

        def threads():
            return len(os.listdir("/proc/self/task"))

        cv2.setNumThreads(1)
        sequence = open_sequence(sys.argv[1], "60,60,160,120")
        before = [float(sequence.image(index).sum()) for index in range(40)]
        decoding = threads()
        close_decoders()
        print(decoding > threads(), [float(sequence.image(index).sum()) for index in range(7, 40)] == before[7:])
        """,
        clip,
    )
    assert printed.split() == ["True", "True"]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_parent_and_fork_read_a_recording_each_at_its_own_place(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("rosbags")
    from tests.data.readers.test_bag import STAMPS, Recording

    recording = Recording(tmp_path / ("r.bag" if kind == "ros1" else "r"), kind)
    for number in range(30):
        recording.image("/image", np.full((480, 640), 8 * number, np.uint8), STAMPS[0] + 10**8 * number)
    printed = run(
        """
        import os, sys, torch
        from torchslam.data import open_sequence

        torch.set_num_threads(1)  # those of OpenMP do not survive a fork

        def numbers(order):
            return [round(float(sequence.image(index).mean()) * 255 / 8) for index in order]

        sequence = open_sequence(sys.argv[1], "60,60,320,240")
        numbers([2])
        if os.fork() == 0:
            found = numbers([3, 29, 0, 5])
            sys.exit(found != [3, 29, 0, 5])
        _, status = os.wait()
        print(status, numbers(range(3, 30)) == list(range(3, 30)))
        """,
        recording.close(),
    )
    assert printed.split() == ["0", "True"]
