"""Run all sequences and the quick benchmarks, record their metrics, and report what got worse by a tenth.

    python -m experiments.report.run                           # all available: `make report`
    python -m experiments.report.run shelf_bin fr2_desk_20 --no-benchmarks
    python -m experiments.report.run --accept "a stricter gate: fewer wrong poses"

Appends a line to docs/figures/history.jsonl and draws docs/history.md. Exit status 1 where something got worse.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from experiments.common import parser_of
from experiments.report.compare import compare, missing, same_bytes
from experiments.report.draw import DOCS, write
from experiments.report.quick import BENCHMARKS
from experiments.report.record import HISTORY, append, beginning, is_quiet, read_history
from experiments.report.rows import NAMES, run_row
from torchslam.errors import SequenceError

GOT_WORSE = 1


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", default=list(NAMES), help=f"default: {', '.join(NAMES)}")
    parser.add_argument(
        "--accept", metavar="REASON", help="why figures that got worse are right; in the history"
    )
    parser.add_argument("--no-benchmarks", action="store_true")
    parser.add_argument("--history", type=Path, default=HISTORY, metavar="FILE")
    parser.add_argument("--docs", type=Path, default=DOCS, metavar="DIR", help="where the page is drawn")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    history, record = read_history(options.history), beginning()
    for name in options.names:
        try:
            record["sequences"][name] = run_row(name)
        except SequenceError as error:
            print(f"{name}: left out: {error}", file=sys.stderr)
            continue
        print(json.dumps({name: record["sequences"][name]}), flush=True)
    for name, benchmark in {} if options.no_benchmarks else BENCHMARKS.items():
        record["benchmarks"][name] = benchmark()
        print(json.dumps({name: record["benchmarks"][name]}), flush=True)
    if not record["sequences"]:
        raise SystemExit("none of the sequences is at hand: nothing to report")
    worse = compare(record, history)
    record |= {"worse": worse} if worse else {}
    record |= {"accepted": options.accept} if options.accept else {}
    append(record, options.history)
    write([*history, record], options.docs)
    print(f"\n{record['commit'][:10]}{' and changes' if record['is_changed'] else ''} on {record['machine']}")
    if not is_quiet(record):
        print(f"the machine is not quiet (load {record['load']}): times are kept, but compared with nothing")
    for name in missing(record, history):
        print(f"{name}: in the last report, not in this one")
    for name, is_same in same_bytes(record, history).items():
        print(f"{name}: {'the same bytes as' if is_same else 'another trajectory than'} last")
    for words in worse:
        print(f"WORSE: {words}")
    return GOT_WORSE if worse and not options.accept else 0


if __name__ == "__main__":
    sys.exit(main())
