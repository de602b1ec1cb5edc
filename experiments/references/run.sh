#!/usr/bin/env bash
# Both reference trajectories; arguments are passed on, e.g. --parts shuttle --save here
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.references.run "$@"
