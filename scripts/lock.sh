#!/bin/sh
# Rewrite requirements.lock and scripts/uv.txt: exact versions with hashes, without the address of any index.
# Versions already locked are kept; `UPGRADE=1 make lock` takes the newest allowed.
set -eu

cd "$(dirname "$0")/.."
uv=
for candidate in ${UV:+"$UV"} uv .venv-tools/bin/uv "$HOME/.local/bin/uv" "$HOME/.cargo/bin/uv"; do
    if "$candidate" --version >/dev/null 2>&1; then uv=$candidate; break; fi
done
[ -n "$uv" ] || { echo "lock: uv is missing; run 'make setup' first" >&2; exit 1; }

compile() {
    "$uv" pip compile --quiet --universal --python-version 3.12 --python .venv/bin/python --generate-hashes \
        --no-header --no-emit-index-url --no-emit-find-links ${UPGRADE:+--upgrade} "$@" >/dev/null
}

compile --all-extras --group dev --group docs --override scripts/overrides.txt pyproject.toml --output-file requirements.lock
echo uv | compile --no-annotate - --output-file scripts/uv.txt
if grep -nE '://|^--' requirements.lock scripts/uv.txt; then
    echo "lock: the lines above name an address or an option; they must not be committed" >&2
    exit 1
fi
