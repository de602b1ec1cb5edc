"""The refinements side by side from the command line: run parts, write tables, hold them against expected.json."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import torch

from experiments.refinements import compare, paper, units
from experiments.tables import run_study

FOLDER = Path(__file__).parent
PROBLEMS = {"transfer": "earth_mars", "landing": "mars_landing"}
STUDIES = {"": compare.run, "_units": units.run, "_paper": paper.run}
PARTS = {f"{case}{study}": partial(run, name) for study, run in STUDIES.items() for case, name in PROBLEMS.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all of them")
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0 … SEEDS − 1 (default 5)")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    if arguments.seeds < 1:
        parser.error(f"--seeds {arguments.seeds}; allowed: at least 1")
    torch.set_num_threads(1)
    parts = {name: partial(PARTS[name], range(arguments.seeds)) for name in arguments.parts}
    return run_study(FOLDER, parts, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
