"""Linear and deep free functions on the same residuals: run parts, write tables, hold them against expected.json."""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.elm_vs_deep import arcs, landing, layers, transfer
from experiments.tables import run_seeded

FOLDER = Path(__file__).parent
PARTS = {
    "transfer": transfer.run,
    "networks": transfer.run_others,
    "layers": layers.run,
    "few": layers.run_few,
    "landing": landing.run,
    "landing_networks": landing.run_networks,
    "arcs": arcs.run,
}


def main() -> int:
    return run_seeded(FOLDER, PARTS, __doc__, seeds=5)


if __name__ == "__main__":
    sys.exit(main())
