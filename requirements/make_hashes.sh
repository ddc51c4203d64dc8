#!/bin/sh
# Rewrites the hashes of every pinned package's files in the locks: change a pin there, then `make hashes`.
# The pins stay; the registry is asked for the hashes of each (minutes). Local wheels and other indexes are not looked at.
set -eu
cd "$(dirname -- "$0")"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pip-tools==7.6.2
export PIP_CONFIG_FILE=/dev/null
unset PIP_FIND_LINKS PIP_EXTRA_INDEX_URL PIP_INDEX_URL
for name in runtime test docs; do
  sed -n 's/^\([A-Za-z0-9._-]*==[^\\]*\).*/\1/p' "$name.lock" > "$work/$name.in"
  "$work/venv/bin/pip-compile" --quiet --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
    --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --output-file "$work/$name.out" "$work/$name.in"
  { sed -n '/^#/p' "$name.lock"; cat "$work/$name.out"; } > "$work/$name.lock"
  mv "$work/$name.lock" "$name.lock"
done
