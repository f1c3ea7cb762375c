"""Folders and lists of images with names, orders and times as programs write them, and whether they are read as meant.

What is read must be what was meant: each image at its place and time. A folder that can be meant in two ways may be
refused instead, but never be read in the wrong one.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from tests.fuzz.mutators import Files
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.errors import ResultsError, SequenceError
from torchslam.geometry import Camera
from torchslam.io.export.scene import ExampleFrame, ExportedScene, ImageSource, open_images

MEANT = "meant.json"
SIZE = (24, 16)
EPOCH = 1_305_031_102
RATES = (5.0, 15.0, 20.0, 24.0, 29.97, 30.0, 60.0, 100.0)
TOLERANCE = 2e-6
"""Seconds: of times in microseconds, and of numbers of 19 digits as floats."""
UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


@dataclass(frozen=True)
class Naming:
    """Names without suffix of images in order, their times in seconds if they say them, and what may be refused."""

    stems: list[str]
    times: list[float] | None = None
    is_ambiguous: bool = False


def picture(seed: int) -> np.ndarray:
    """(H, W) uint8, another one for each seed."""
    return np.random.default_rng(seed).integers(0, 256, SIZE[::-1], dtype=np.uint8)


# --- names ---------------------------------------------------------------------------------------------------


def _counted(rng: random.Random, count: int) -> Naming:
    """A counter, with or without leading zeros, from anywhere, with steps."""
    start, step, digits = map(rng.choice, ((0, 1, 7, 95, 998), (1, 1, 2, 5, 10), (1, 1, 4, 6)))
    starts = ("", "img", "IMG_", "frame-", "left.", "cam0_", "Bild ä ", "2024-05-01_", "shot1.", "v1.2.")
    before = rng.choice(starts)
    after = rng.choice(("", "", "_left", "-rgb"))
    return Naming([f"{before}{start + step * index:0{digits}d}{after}" for index in range(count)])


def _dated(rng: random.Random, count: int) -> Naming:
    days = sorted(rng.sample(range(1, 29), min(count, 28)))
    mark, digits = rng.choice(".-_"), rng.choice((1, 2))
    return Naming([f"2024{mark}5{mark}{day:0{digits}d}" for day in days])


def _moments(rng: random.Random, count: int, start: int) -> list[int]:
    """Nanoseconds of images at some rate, with jitter, or drops."""
    period = 1e9 / rng.choice(RATES)
    first = start * 10**9 + rng.randrange(10**9)
    steps = (period * rng.choice((1, 1, 1, 2)) * rng.uniform(0.9, 1.1) for _ in range(count))
    moments = [first]
    for step in steps:
        moments.append(moments[-1] + round(step))
    return moments[:count]


def _timed(rng: random.Random, count: int) -> Naming:
    """Times since 1970 as a float in the shortest form, a decimal of fixed length, or a count."""
    moments = _moments(rng, count, EPOCH + rng.randrange(10**8))
    before, after = rng.choice(("", "", "rgb_", "frame-", "cam0 ")), rng.choice(("", "", "_left"))
    kind = rng.choice(("shortest", "fixed", "count"))
    if kind == "count":
        unit = UNITS[rng.choice(("ms", "us", "ns"))]
        texts = [str(moment * unit // 10**9) for moment in moments]
        times = [int(text) / unit for text in texts]
    elif kind == "fixed":
        digits = rng.choice((3, 6, 9))
        texts = [f"{moment // 10**9}.{moment % 10**9:09d}"[: 11 + digits] for moment in moments]
        times = [float(text) for text in texts]
    else:
        times = [round(moment / 1e9, rng.choice((3, 4, 6))) for moment in moments]
        texts = [repr(time) for time in times]
    # Without any zero after a dot, few images may as well have lost it.
    is_ambiguous = kind == "shortest" and not any(".0" in text for text in texts)
    return Naming([f"{before}{text}{after}" for text in texts], times, is_ambiguous)


def _elapsed(rng: random.Random, count: int) -> Naming:
    """Seconds since the start, by names that are nothing else."""
    times = [round(moment / 1e9, 3) for moment in _moments(rng, count, rng.choice((0, 9, 98)))]
    return Naming([repr(time) for time in times], times)


def _without_zeros(rng: random.Random, count: int) -> Naming:
    """Seconds, a dot and a count of nanoseconds whose leading zeros are missing: no decimals."""
    moments = _moments(rng, count, EPOCH)
    while len({len(str(moment % 10**9)) for moment in moments}) == 1:  # these could be decimals as well
        moments = _moments(rng, count, EPOCH)
    stems = [f"{moment // 10**9}.{moment % 10**9}" for moment in moments]
    return Naming(stems, is_ambiguous=True)


NAMINGS: list[Callable[[random.Random, int], Naming]] = [
    *(_counted, _counted, _dated, _timed, _timed, _timed, _elapsed, _without_zeros),
]


def _naming(rng: random.Random) -> Naming:
    return rng.choice(NAMINGS)(rng, rng.randrange(3, 16))


def _encoded(seed: int, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, picture(seed))[1])


def named_folder(rng: random.Random) -> Files:
    """A folder of images with names of some kind, and with what lies beside images."""
    naming, suffix = _naming(rng), rng.choice((".png", ".PNG", ".bmp", ".tif", ".pgm"))
    folder = rng.choice(("", "", "images/", "rgb/"))
    names = [stem + suffix for stem in naming.stems]
    files = {folder + name: _encoded(seed, suffix.lower()) for seed, name in enumerate(names)}
    stray = rng.choice(("", "", "._" + names[0], "mask.png", "depth_1.png", "notes.txt", "a.heic"))
    if stray:
        files[folder + stray] = b"x"
    if folder and rng.random() < 0.5:
        files["preview.png"] = _encoded(99, ".png")
    meant: dict[str, Any] = {"names": names, "times": naming.times, "is_ambiguous": naming.is_ambiguous}
    order = sorted(files, key=lambda _: rng.random())  # the system lists them in any
    return {name: files[name] for name in order} | {MEANT: json.dumps(meant).encode()}


def read_named_folder(root: Path) -> None:
    """Images have the order and the times that their names mean."""
    meant = json.loads((root / MEANT).read_text())
    try:
        sequence = open_sequence(root)
    except SequenceError:
        assert meant["is_ambiguous"], "refused, but it can be meant in one way alone"
        raise
    _check_pictures(sequence, range(len(meant["names"])))
    assert [Path(sequence.image_name(index)).name for index in range(len(sequence))] == meant["names"]
    count = len(sequence)
    times = [index / 30 for index in range(count)] if meant["times"] is None else meant["times"]
    _check_times(sequence, times)


def _check_pictures(sequence: Sequence, seeds: range) -> None:
    assert len(sequence) == len(seeds)
    for index, seed in enumerate(seeds):
        gray = (sequence.image(index)[0, 0] * 255).round().numpy()
        assert np.array_equal(gray, picture(seed)), f"another image at {index}"


def _check_times(sequence: Sequence, times: list[float], tolerance: float = TOLERANCE) -> None:
    off = (sequence.timestamps - torch.tensor(times, dtype=torch.float64)).abs().max()
    assert float(off) < tolerance, f"times off by {float(off)} s"


# --- lists ---------------------------------------------------------------------------------------------------


def listed_images(rng: random.Random) -> Files:
    """A list as of TUM, or a sequence of KITTI, with times in some unit, in order or not."""
    count = rng.randrange(3, 10)
    start = rng.choice((0, EPOCH))
    unit = rng.choice(list(UNITS)) if start else rng.choice(("s", "s", "ns"))
    moments = _moments(rng, count, start)
    if unit == "s":
        texts = [f"{moment / 1e9:.6f}" for moment in moments]
    else:
        texts = [str(moment * UNITS[unit] // 10**9) for moment in moments]
    lines = list(range(count))
    if rng.random() < 0.2:
        rng.shuffle(lines)
    end = rng.choice(("\n", "\r\n"))
    files: Files = {}
    if rng.random() < 0.3:
        files["times.txt"] = "".join(f"{texts[line]}{end}" for line in lines).encode()
        files["calib.txt"] = b"P0: 20 0 12 0 0 20 8 0 0 0 1 0\n"
        names = [f"image_0/{index:06d}.png" for index in range(count)]
    else:
        names = [rng.choice((f"rgb/{texts[index]}.png", f"rgb/{index}.png")) for index in range(count)]
        rows = [f"{texts[line]} {rng.choice(('', './'))}{names[line]}{end}" for line in lines]
        files["rgb.txt"] = "".join(["# timestamp filename" + end, *rows]).encode()
    # What cannot be told from seconds of another epoch is refused.
    is_plain = lines == sorted(lines) and (start != 0 or unit == "s")
    meant = {"times": [moment / 1e9 for moment in moments], "is_ambiguous": not is_plain, "unit": unit}
    files |= {name: _encoded(seed, ".png") for seed, name in enumerate(names)}
    return files | {MEANT: json.dumps(meant).encode()}


def read_listed_images(root: Path) -> None:
    """Images have the times that the list gives, in seconds, whatever the unit."""
    meant = json.loads((root / MEANT).read_text())
    try:
        sequence = open_sequence(root)
    except SequenceError:
        assert meant["is_ambiguous"], "refused, but it can be meant in one way alone"
        raise
    assert not meant["is_ambiguous"], "out of order or in an unknown unit, but read"
    _check_pictures(sequence, range(len(meant["times"])))
    off = TOLERANCE + (1e-3 if meant["unit"] == "ms" else 0)  # which are rounded down
    _check_times(sequence, meant["times"], off)


# --- images of results ---------------------------------------------------------------------------------------


def changed_folder(rng: random.Random) -> Files:
    """A folder as a run read it, and as it is at an export: files are gone, new, moved, converted or others."""
    naming = _naming(rng)
    names = [f"{stem}.png" for stem in naming.stems]
    seeds = {name: seed for seed, name in enumerate(names)}
    before = {f"before/{name}": _encoded(seed, ".png") for name, seed in seeds.items()}
    after = dict(seeds)
    kind = rng.choice(("same", "deleted", "added", "converted", "overwritten", "other"))
    if kind == "deleted":
        for name in rng.sample(names, rng.randrange(1, len(names))):
            del after[name]
    elif kind == "added":
        after |= {f"{rng.choice(('0', 'a', 'zz'))}{rng.randrange(100)}.png": 50 + extra for extra in range(2)}
    elif kind == "converted":
        after = {name.removesuffix(".png") + ".bmp": seed for name, seed in after.items()}
    elif kind in ("overwritten", "other"):  # by those of another recording, under the same names or others
        after = {name if kind == "overwritten" else f"b{name}": 50 + seed for name, seed in after.items()}
    folder = rng.choice(("after", "moved/after"))
    files = {f"{folder}/{name}": _encoded(seed, Path(name).suffix) for name, seed in after.items()}
    posed = sorted(rng.sample(range(len(names)), rng.randrange(1, len(names) + 1)))
    meant = {"posed": posed, "example": rng.choice(posed), "kind": kind, "folder": folder}
    return before | files | {MEANT: json.dumps(meant).encode()}


def read_changed_folder(root: Path) -> None:
    """Each frame gets its own image, or none does."""
    meant = json.loads((root / MEANT).read_text())
    run = open_sequence(root / "before")
    ids = torch.tensor(meant["posed"])
    nothing = torch.zeros(0, dtype=torch.int64)
    scene = ExportedScene(
        camera=Camera.pinhole(20.0, 20.0, 12.0, 8.0, SIZE),
        frame_ids=ids,
        timestamps=run.timestamps[ids],
        is_keyframe=torch.ones(len(ids), dtype=torch.bool),
        T_cw=torch.eye(4).repeat(len(ids), 1, 1),
        points_w=torch.zeros(0, 3),
        colors=torch.zeros(0, 3, dtype=torch.uint8),
        frame_index=nothing,
        point_index=nothing,
        pixels=torch.zeros(0, 2),
    )
    example = meant["example"]
    source = ImageSource(
        str(root / meant["folder"]),
        files={index: run.file_name(index) for index in range(len(run))},
        example=ExampleFrame(example, run.timestamp(example), run.image(example)),
    )
    try:
        images = open_images(source, scene)
    except ResultsError:
        assert meant["kind"] not in ("same", "converted"), "refused, but all images are there"
        raise
    for frame_id in meant["posed"]:
        original = (run.image(frame_id)[0, 0] * 255).round().numpy()
        assert np.array_equal(images.bgr(frame_id)[..., 0], original), f"another image for frame {frame_id}"
