#!/usr/bin/env bash
# Installs into .venv, then runs format, lint, types, layers and tests; see scripts/test.py.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec python scripts/test.py "$@"
