"""All wrong inputs, each in a process that can be ended: python -m tests.fuzz [--inputs 30000] [--only READER[:NUMBER]]

A process that hangs, dies or exceeds its memory limit is counted with the rest. Exit status 1 where an
input was not read or refused as it should be.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict
from io import RawIOBase
from pathlib import Path

import torch

from tests.fuzz.inputs import MEGABYTES, PATIENCE, WALL, Outcome, clear, numbers, outcome
from tests.fuzz.readers import Reader, readers

GRACE = 2.0
"""Times the patience, of processor and wall, after which a process is taken to hang in what no signal reaches."""
LOOK = 1.0
"""Seconds from one look at its use of the processor to the next."""
TICKS = os.sysconf("SC_CLK_TCK")
ROOM = 3 * MEGABYTES << 20
"""Address space in bytes that a process may use in addition to the libraries."""
GOOD = ("read", "refused")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--inputs", type=int, default=30_000)
    parser.add_argument(
        "--patience", type=float, default=PATIENCE, help="seconds of the processor for an input"
    )
    parser.add_argument("--only", default="", metavar="READER[:NUMBER]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    name, _, number = options.only.partition(":")
    wrong = 0
    print(
        f"{'reader':26} {'inputs':>6} {'read':>6} {'refused':>7} {'wrong':>5} {'slowest':>8} {'largest':>8}"
    )
    total = 0
    for reader in readers().values():
        if name and not reader.name.startswith(name):
            continue
        tried = [int(number)] if number else list(numbers(reader.inputs, options.inputs))
        outcomes = dict(_outcomes(reader, tried, options.patience))
        total += len(tried)
        wrong += _report(reader, outcomes)
    print(f"{wrong} of {total} inputs were not read or refused as they should be")
    return int(wrong > 0)


def _report(reader: Reader, outcomes: dict[int, Outcome]) -> int:
    """A line for the reader, and one for each kind of what is wrong; returns how many are."""
    verdicts = Counter(each.verdict for each in outcomes.values())
    wrong = {number: each for number, each in outcomes.items() if each.verdict not in GOOD}
    seconds = max((each.seconds for each in outcomes.values()), default=0)
    megabytes = max((each.megabytes for each in outcomes.values()), default=0)
    counts = f"{verdicts['read']:6} {verdicts['refused']:7} {len(wrong):5}"
    print(f"{reader.name:26} {len(outcomes):6} {counts} {seconds:6.2f} s {megabytes:5.0f} MB", flush=True)
    kinds: dict[str, list[int]] = defaultdict(list)
    for number, each in wrong.items():
        kind = each.what.partition(": ")[0] if each.verdict == "raw error" else ""
        kinds[f"{each.verdict} {kind}"].append(number)
    for found in kinds.values():
        first = wrong[found[0]]
        what = first.what.strip().splitlines()[-4:] if first.what else []
        print(
            f"    {len(found)} x {first.verdict} ({reader.name}:{found[0]}): {' '.join(map(str.strip, what))}",
            flush=True,
        )
    return len(wrong)


def _outcomes(reader: Reader, tried: list[int], patience: float) -> Iterator[tuple[int, Outcome]]:
    """What comes of each input, in a process that is started anew after one that had to be ended."""
    left = tried
    while left:
        done = 0
        for number, found in _process(reader, left, patience):
            done += 1
            yield number, found
        if done == len(left):
            return
        left = left[done:]


def _process(reader: Reader, tried: list[int], patience: float) -> Iterator[tuple[int, Outcome]]:
    """The outcomes of a process, the last one of what ended it."""
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        _work(reader, tried, sending, patience)
    os.close(sending)
    with os.fdopen(receiving, "rb", buffering=0) as lines:  # a line in a buffer would not wake `select`
        for number in tried:
            ready = _answers(lines, child, patience)
            line = lines.readline() if ready else b""
            if not line:
                os.kill(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
                yield number, Outcome("death" if ready else "hang", f"status {status}", GRACE * patience, 0)
                return
            yield number, Outcome(**json.loads(line))
    os.waitpid(child, 0)


def _answers(lines: RawIOBase, child: int, patience: float) -> bool:
    """Whether a line, or the end, comes from a process before it is taken to hang."""
    limit, end = _processor(child) + GRACE * patience, time.monotonic() + GRACE * WALL * patience
    while _processor(child) < limit and time.monotonic() < end:
        if select.select([lines], [], [], LOOK)[0]:
            return True
    return False


def _processor(process: int) -> float:
    """Seconds of the processor that a process, or what is left of it, has used."""
    numbers = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, numbers[11:13])) / TICKS  # utime and stime, proc(5)


def _work(reader: Reader, tried: list[int], sending: int, patience: float) -> None:
    """In the process: one line for each input, one at a time, so that none waits in a buffer."""
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 2)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    scratch = Path(tempfile.mkdtemp(prefix="torchslam-fuzz-"))
    tempfile.tempdir = str(scratch)
    for number in tried:
        os.write(sending, json.dumps(asdict(outcome(reader, number, scratch, patience))).encode() + b"\n")
    clear(scratch)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
