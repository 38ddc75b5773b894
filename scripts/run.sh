#!/usr/bin/env bash
# Installs into .venv, then runs the main job on a simulated recording; see scripts/run.py.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec python scripts/run.py "$@"
