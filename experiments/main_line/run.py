"""The numbers of the main line from the command line: run parts, write tables, hold them against expected.json."""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.main_line import smoothed, split, starts, unsplit
from experiments.tables import run_seeded

FOLDER = Path(__file__).parent
PARTS = {
    "smoothed": smoothed.run,
    "starts": starts.run,
    "pointwise": unsplit.run_pointwise,
    "weak": unsplit.run_weak,
    "split": split.run,  # last: its times are quoted
}


def main() -> int:
    return run_seeded(FOLDER, PARTS, __doc__, seeds=20)


if __name__ == "__main__":
    sys.exit(main())
