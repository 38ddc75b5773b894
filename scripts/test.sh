#!/usr/bin/env bash
# Everything that must hold before a merge: format, lint, types, layers, tests.
# Arguments go to pytest; `bash scripts/test.sh -m slow` runs the long checks.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
if [ -z "${TOFCORR_REAL_DATA:-}" ] && [ -d ../shared/real ]; then
  TOFCORR_REAL_DATA=$(realpath ../shared/real)
  export TOFCORR_REAL_DATA
fi
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}   # Two test workers share two cores.
ruff format --check --quiet .
ruff check --quiet .
pyright
lint-imports
if [ $# -gt 0 ]; then
  exec pytest -n 2 "$@"
fi
exec pytest -n 2 -m "not slow and not gpu"
