#!/usr/bin/env bash
# This study's tables and figures; arguments are passed on, e.g. --seeds 2 --check-only
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export OMP_NUM_THREADS=1
exec "${PYTHON:-python}" -m experiments.continuation_schedules.run "$@"
