#!/usr/bin/env bash
# Makes .venv with the pinned dependencies, once; later calls return at once. Sourced by the others.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
wanted=$(cat scripts/requirements.txt scripts/requirements.in pyproject.toml | sha256sum | cut -d' ' -f1)
if [ "$(cat .venv/.installed 2>/dev/null || true)" != "$wanted" ]; then
  python=${PYTHON:-$(command -v python3.11 || command -v python3)}
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "tofcorr needs Python 3.11 or newer; found $("$python" --version)." >&2
    exit 2
  }
  echo "Installing into .venv (a few minutes, once)."
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  export PIP_DISABLE_PIP_VERSION_CHECK=1
  # Most files are never imported; the others are compiled when they are. Half of the time is saved.
  install=(.venv/bin/python -m pip install --quiet --no-compile)
  # Pinned to the last one (tests/package/test_metadata.py): there is nothing to resolve, and nothing
  # asks for a bare torch, which would bring several GB of CUDA. Another content than that which was
  # pinned is refused.
  "${install[@]}" --no-deps --require-hashes -r scripts/requirements.txt
  # Its build for the processor alone has another hash in every index.
  "${install[@]}" "$(grep '^torch==' scripts/requirements.in)"
  "${install[@]}" --no-deps --no-build-isolation --editable .
  echo "$wanted" > .venv/.installed
fi
# What is imported is compiled once, not in every program again.
unset PYTHONDONTWRITEBYTECODE
export PATH="$PWD/.venv/bin:$PATH"
