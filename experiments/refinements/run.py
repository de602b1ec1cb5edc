"""The refinements side by side from the command line: run parts, write tables, hold them against expected.json."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from experiments.refinements import compare, paper, units
from experiments.tables import run_seeded

FOLDER = Path(__file__).parent
PROBLEMS = {"transfer": "earth_mars", "landing": "mars_landing"}
STUDIES = {"": compare.run, "_units": units.run, "_paper": paper.run}
PARTS = {f"{case}{study}": partial(run, name) for study, run in STUDIES.items() for case, name in PROBLEMS.items()}


def main() -> int:
    return run_seeded(FOLDER, PARTS, __doc__, seeds=5)


if __name__ == "__main__":
    sys.exit(main())
