#!/usr/bin/env bash
# The table of this study; arguments are passed on, e.g. --count 20
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.powered_descent.run "$@"
