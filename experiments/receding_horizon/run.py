"""The numbers of receding-horizon control: run parts, write tables and figures, hold them against expected.json."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from experiments.receding_horizon import methods, quadrotor, rendezvous, shuttle, timing
from experiments.tables import run_study

FOLDER = Path(__file__).parent
PARTS = {
    "rendezvous": rendezvous.run,
    "integral": rendezvous.run_integral,
    "costs": quadrotor.run_costs,
    "tolerance": quadrotor.run_tolerance,
    "passes": quadrotor.run_passes,
    "methods": methods.run_six,
    "swarm": methods.run_swarm,
    "monte_carlo": shuttle.run_monte_carlo,
    "sweep": shuttle.run_sweep,
    "timing": timing.run,  # last: its times are quoted
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all of them")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    (FOLDER / "results").mkdir(exist_ok=True)
    return run_study(FOLDER, {name: PARTS[name] for name in arguments.parts}, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
