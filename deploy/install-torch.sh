#!/bin/sh
# Install the pinned torch with the PIP that is named: the build for CPUs where pip is told of one (PIP_FIND_LINKS,
# PIP_EXTRA_INDEX_URL or pip.conf), else the usual one, with CUDA's libraries where it wants them.
set -eu
pip=$1
folder=$(dirname "$0")/..
cpu=$(sed -n 's/^torch==\([^ ]*\).*/\1/p' "$folder/requirements-torch-cpu.txt")
if ! offered=$(env -u PIP_QUIET "$pip" index versions torch 2>&1)
then
  echo "$offered" >&2
  exit 1
fi
if echo "$offered" | sed -n '/^Available/p' | grep -qwF "$cpu"
then "$pip" install --quiet --require-hashes --no-deps -r "$folder/requirements-torch-cpu.txt"
else "$pip" install --quiet --require-hashes -r "$folder/requirements-torch.txt"
fi
