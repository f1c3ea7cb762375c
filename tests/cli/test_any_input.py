"""Whatever a path leads to, a command gives results, or one line on stderr and a documented status."""

from __future__ import annotations

import os
import re
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz import valid_inputs
from tests.fuzz.mutators import Entry, Mutated, write
from torchslam.cli.main import main

STATUSES = {"run": (0, 2, 3), "batch": (0, 2, 4)}
"""Documented ones of a command; others: 0 and 2."""
NAMES = st.sampled_from(
    [
        *(
            "a.png",
            "b.png",
            "7.jpg",
            "rgb.txt",
            "groundtruth.txt",
            "times.txt",
            "calib.txt",
            "calibration.txt",
        ),
        *(
            "metadata.yaml",
            "r.bag",
            "r.mcap",
            "v.mp4",
            "z.zip",
            "c.toml",
            "l.csv",
            "l.txt",
            "transforms.json",
        ),
        *("images.bin", "cameras.txt", "map.safetensors", "metrics.json", "frames.csv", "trajectory.txt"),
        *("é ñ.png", "\x1b[31m.png", "no suffix", ".hidden", "x" * 120 + ".png"),
    ]
)
FOLDERS = st.sampled_from(["", "rgb/", "images/", "image_0/", "mav0/cam0/data/", "a/b/c/"])
CONTENTS = st.one_of(
    st.binary(max_size=60),
    st.text(max_size=60).map(lambda text: text.encode("utf-8", "surrogatepass")),
    st.sampled_from(
        [
            *(content for name, content in valid_inputs.tum().items() if not name.endswith("1.png")),
            *(files[name] for files in valid_inputs.images().values() for name in files),
            valid_inputs.BATCH_TEXT.encode(),
            b"1 2 3 nan\n",
            b"{}",
            b"[1]",
            b"#ROSBAG V2.0\n",
            b"\x89MCAP0\r\n",
            b"PK\x03\x04",
        ]
    ),
    st.sampled_from([Entry.FOLDER, Entry.PIPE, Entry.ENDLESS, Entry.CIRCLE]),
)
TREES = st.dictionaries(st.tuples(FOLDERS, NAMES).map("".join), CONTENTS, min_size=1, max_size=8)
COMMANDS = st.sampled_from(
    [
        *(
            ["run", "{}", "-o", "{out}", "--camera", "60,60,31.5,23.5"],
            ["run", "{}", "-o", "{out}", "--mask", "{}"],
        ),
        ["run", "synthetic:room?frames=2", "-o", "{out}", "--config", "{}"],
        ["run", "synthetic:room?frames=2", "-o", "{out}", "--map", "{}"],
        ["run", "synthetic:room?frames=2", "-o", "{out}", "--camera", "{}"],
        ["refine", "{}", "--poses", "{}", "-o", "{out}"],
        *(["info", "{}"], ["eval", "{}", "{}"], ["plot", "{}"], ["batch", "{}", "-o", "{out}"]),
        *(["export", "{}", "--to", "colmap", "-o", "{out}"], ["densify", "{}"], ["config", "--config", "{}"]),
    ]
)


def grown(tree: Mutated, root: Path) -> list[Path]:
    """The tree below a folder, as far as its names allow: every file and folder in it, and one that is missing."""
    for name, content in tree.items():
        try:
            write({name: content}, root)
        except OSError:  # a file where a folder is to be, or the other way round
            continue
    return sorted([root, root / "missing", *root.rglob("*")])


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(tree=TREES, command=COMMANDS, choice=st.integers(0, 10**6))
def test_any_path_gives_results_or_one_line(
    tmp_path_factory: pytest.TempPathFactory,
    capfd: pytest.CaptureFixture[str],
    tree: Mutated,
    command: list[str],
    choice: int,
) -> None:
    base = tmp_path_factory.mktemp("tree")
    root = base / "tree"
    root.mkdir()
    paths = grown(tree, root)
    chosen = os.fspath(paths[choice % len(paths)])
    arguments = [part.format(chosen, out=base / "out") for part in command]
    capfd.readouterr()
    status = main(arguments)
    said = capfd.readouterr()
    assert status in STATUSES.get(command[0], (0, 2)), (arguments, said.err)
    errors = [line for line in said.err.split("\n") if line.startswith("torchslam: error:")]
    assert len(errors) == (status == 2), (arguments, said.err)
    assert all(line.isprintable() for line in re.split("[\r\n]", said.out + said.err))
    assert "Traceback" not in said.err
