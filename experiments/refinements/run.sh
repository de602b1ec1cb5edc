#!/usr/bin/env bash
# All tables of this study; arguments are passed on, e.g. --parts units --seeds 2
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.refinements.run "$@"
