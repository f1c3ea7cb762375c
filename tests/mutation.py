"""Mutation testing of the system layer, and of what it does for every frame: does a small change make tests fail?

python -m tests.mutation --sample 200 --seed 0

mutmut makes a copy of the repository with all its changes in `mutants/` and runs for each the tests that reach it; what
it mutates and which tests it runs stands in pyproject.toml. Without a sample all are tried: hours. Afterwards
`mutmut show NAME` prints a change that no test noticed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
KILLED, SURVIVED, UNTESTED = (
    (1, 3),
    (0,),
    (5, 33),
)  # exit codes of pytest, and mutmut's for what no test reaches


def mutmut(*arguments: str) -> None:
    """Run mutmut with one torch thread and one process; what it prints of mutants is not of interest here."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(done.stdout[-4000:] + done.stderr[-4000:])


def results() -> dict[str, int | None]:
    """Exit codes by the names of all mutants; None where it was not tried."""
    files = sorted((ROOT / "mutants").rglob("*.meta"))
    return {
        name: code
        for file in files
        for name, code in json.loads(file.read_text())["exit_code_by_key"].items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sample", type=int, default=0, help="how many mutants to try; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--within", default="", help="only mutants whose name has this in it")
    options = parser.parse_args()
    if options.sample == 0 and not options.within:
        mutmut()
        names = sorted(results())
    else:
        mutmut("torchslam.system.savepoint.*")  # a few, so that all mutants are made and the tests are timed
        names = sorted(name for name in results() if options.within in name)
        if 0 < options.sample < len(names):
            names = sorted(random.Random(options.seed).sample(names, options.sample))
        mutmut(*names)
    report({name: code for name, code in results().items() if name in set(names)})


def report(codes: dict[str, int | None]) -> None:
    """How many mutants were killed, by module, and who survived."""
    killed: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    for name, code in codes.items():
        module = name.rsplit(".", 1)[0]
        tried[module] += 1
        killed[module] += code not in SURVIVED + UNTESTED
    for module, count in sorted(tried.items()):
        print(f"{module:45} {killed[module]:4} of {count}")
    for name, code in sorted(codes.items()):
        if code in SURVIVED + UNTESTED:
            print("survived" if code in SURVIVED else "no test", name)
    print(f"killed {sum(killed.values())} of {len(codes)}: {sum(killed.values()) / max(len(codes), 1):.1%}")


if __name__ == "__main__":
    main()
