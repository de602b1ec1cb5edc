#!/usr/bin/env bash
# All tables of this study; arguments are passed on, e.g. --seeds 1
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.singular_arcs.run "$@"
