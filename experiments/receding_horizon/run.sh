#!/usr/bin/env bash
# All tables and figures of this study; arguments are passed on, e.g. --parts rendezvous timing
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.receding_horizon.run "$@"
