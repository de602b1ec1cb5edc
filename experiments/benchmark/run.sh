#!/usr/bin/env bash
# The timings of this study; arguments are passed on, e.g. --repeats 5 --seeds 3
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.benchmark.run "$@"
