#!/usr/bin/env bash
# All tables of this study; arguments are passed on, e.g. --count 10
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.lunar_descents.run "$@"
