"""Run the default command on every recording, write the figures and the tables, and report what got worse.

    python -m experiments.report.run --peers DIR            # all: `make report PEERS=DIR`
    python -m experiments.report.run shelf_bin kitti07      # some: printed and compared, nothing is written
    python -m experiments.report.run --accept "a stricter gate: fewer wrong poses"

Compares with docs/figures/report.json of the last commit. Exit status 1 if something got worse.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.common import available, parser_of
from experiments.report import record, tables
from experiments.report.compare import compare
from experiments.report.rows import ALL, run_row

GOT_WORSE = 1
BUSY = 0.5
"""Load at the start beyond which other processes make CPU times longer."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", metavar="RECORDING", help=f"default: {', '.join(ALL)}")
    parser.add_argument("--accept", metavar="REASON", help="why figures may be worse; stored with them")
    parser.add_argument("--peers", type=Path, metavar="DIR", help="environment of ORB-SLAM3 and pycolmap")
    parser.add_argument(
        "--online", action="store_true", help="run --mapping online as well, and print the ratio of CPU times"
    )
    parser.add_argument("--write", action="store_true", help="write the report even of some recordings")
    parser.add_argument("--output", type=Path, default=Path("results/report"), metavar="DIR")
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.names) - set(ALL)):
        parser.error(f"{', '.join(unknown)}: no such recording; there are {', '.join(ALL)}")
    report, earlier = record.beginning(), record.committed()
    if report["load"] is not None and report["load"] > BUSY:
        print(f"the machine is busy (load {report['load']}): CPU times may be longer", file=sys.stderr)
    for name in available(options.names or ALL):
        report["rows"][name] = run_row(ALL[name], options.output, options.peers, options.online)
        print(json.dumps({name: report["rows"][name]}), flush=True)
    if not report["rows"]:
        raise SystemExit("no recording is available: nothing to report")
    worse = [] if earlier is None else compare(report, earlier)
    report |= {"worse": worse} if worse else {}
    report |= {"accepted": options.accept} if worse and options.accept else {}
    if options.write or not options.names:
        record.write(report)
        tables.write(report)
        for name in () if earlier is None else earlier["rows"].keys() - report["rows"].keys():
            print(f"{name}: in the last report, not in this one")
    for line in worse:
        print(f"WORSE: {line}")
    return GOT_WORSE if worse and not options.accept else 0


if __name__ == "__main__":
    sys.exit(main())
