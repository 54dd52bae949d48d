#!/usr/bin/env bash
# Pin what the images install, by version and hash: requirements.txt, and build-requirements.txt for the kernels.
#   deploy/lock.sh [--upgrade]    run it after a change of pyproject.toml; needs uv (pip install uv)
# Without --upgrade it keeps the versions that still fit. For other extras, add them here and run it again.
set -euo pipefail
cd "$(dirname "$0")"
lock() { # FILE ARGUMENTS...
  uv pip compile --quiet --no-config --no-annotate --generate-hashes --default-index https://pypi.org/simple \
    --python-version 3.11 --python-platform x86_64-manylinux_2_28 --custom-compile-command deploy/lock.sh \
    --output-file "$@"
}
lock requirements.txt ../pyproject.toml --extra sim --extra metrics --extra postgres --extra grounding --extra llm "$@"
lock build-requirements.txt --group ../pyproject.toml:build "$@"
