"""One wrong input by its reader and number, what came of it, and whether that is as it should be."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from tests.fuzz import conventions, valid_inputs
from tests.fuzz.mutators import Mutated, mutate, write
from tests.fuzz.readers import Reader
from torchslam.errors import TorchslamError

SECONDS = 10.0
"""Of the processor: no input may take longer, however busy the machine is."""
PATIENCE = 3 * SECONDS
"""After so many it is ended."""
WALL = 20
"""Times the patience, on the wall: the end of what waits for ever, for which the processor has nothing to do."""
MEGABYTES = 1024
"""Nor more memory on top of what the program has."""
LONGEST = 4000
"""Characters of a message."""


class TooLong(BaseException):
    """An input takes more than its time."""


@dataclass(frozen=True)
class Outcome:
    """verdict: "read", "refused" (as it should be), or what is wrong; seconds and megabytes that it took"""

    verdict: str
    what: str
    seconds: float
    megabytes: float


def mutated(reader: Reader, number: int) -> Mutated:
    """Return the input of a number; it depends on the number alone."""
    rng = random.Random(f"{reader.name} {number}")
    if reader.generate is not None:
        return dict(reader.generate(rng))
    files = dict(reader.files)
    if reader.name == "settings of a run":
        return {"argument": valid_inputs.extreme_setting(rng).encode()}
    if reader.name == "calibration conventions":
        return dict(conventions.example(rng))
    if "argument" in files:
        examples = valid_inputs.OVERRIDES if reader.name == "--set" else valid_inputs.CAMERA_ARGUMENTS
        files["argument"] = rng.choice(examples).encode()
    elif reader.name == "frame arguments":
        return {**files, **mutate({"argument": rng.choice(valid_inputs.FRAME_ARGUMENTS).encode()}, rng)}
    return mutate(files, rng)


def outcome(reader: Reader, number: int, scratch: Path, patience: float = PATIENCE) -> Outcome:
    """Write the input, read it and judge. patience: seconds of the processor; WALL times as many on the wall."""
    root = scratch / "wrong input"
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir()
    files = mutated(reader, number)
    try:
        write(files, root)
    except (OSError, ValueError):  # a name that the system does not take
        return Outcome("read", "", 0.0, 0.0)
    before, start = _memory(reset=True), time.process_time()
    _stop_after(patience)
    try:
        verdict, what = _verdict(reader, root)
    except TooLong:
        verdict, what = "hang", traceback.format_exc(limit=-3)
    finally:
        _stop_after(0)
    seconds, megabytes = time.process_time() - start, _memory() - before
    if verdict in ("read", "refused") and (seconds > SECONDS or megabytes > MEGABYTES):
        verdict, what = "too much", f"{seconds:.1f} s, {megabytes:.0f} MB"
    return Outcome(verdict, what, seconds, megabytes)


def _verdict(reader: Reader, root: Path) -> tuple[str, str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reader.read(root)
        except TorchslamError as error:
            return _judged(reader, str(error), root)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)
            own = [frame for frame in place if "torchslam" in frame.filename] or list(place)
            at = f"{Path(own[-1].filename).name}:{own[-1].name}"
            return "raw error", f"{type(error).__name__} in {at}: {str(error)[:150]}"
    return "read", ""


def _judged(reader: Reader, message: str, root: Path) -> tuple[str, str]:
    """Is a message one line that can be shown, and does it say where?"""
    if not message.isprintable() or not message or len(message) > LONGEST:
        return "unclear", f"not one line: {message[:200]!r}"
    places = {root.name, "--", "passwd", *(part for name in reader.files for part in Path(name).parts)}
    places |= {Path(name).stem for name in reader.files}
    if reader.generate is not None:
        places.add(str(root))
    if not any(place in message for place in places):
        return "unclear", f"no place: {message[:200]}"
    return "refused", ""


def _stop_after(seconds: float) -> None:
    """Raise TooLong in here after seconds of the processor, or WALL times as many on the wall; 0: no longer."""
    for timer, sent, factor in (
        (signal.ITIMER_PROF, signal.SIGPROF, 1),
        (signal.ITIMER_REAL, signal.SIGALRM, WALL),
    ):
        signal.signal(sent, _stop)
        signal.setitimer(timer, factor * seconds)


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooLong


def _memory(reset: bool = False) -> float:
    """Megabytes: the highest since the last reset, or, with one, what there is now. 0 where the system does not say."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0.0
    key = "VmRSS:" if reset else "VmHWM:"
    return int(status.partition(key)[2].split()[0]) / 1024


def numbers(inputs: int, whole: int) -> range:
    """Which of a reader's `inputs` are tried where `whole` of 30,000 are."""
    return range(0, inputs, max(1, 30_000 // whole))


def clear(scratch: Path) -> None:
    """Leave nothing, whatever its rights and names."""
    shutil.rmtree(os.fsencode(scratch), ignore_errors=True)
