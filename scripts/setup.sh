#!/bin/sh
# Set up this checkout: GL packages if no GL renders, a Python >= 3.12, uv, and .venv from requirements.lock.
# Asks nothing. A second call only verifies. POSIX sh; needs git, make and any python3 beforehand.
set -eu

root=$(cd "$(dirname "$0")/.." && pwd)
cd "$root"
venv=$root/.venv
tools=$root/.venv-tools
stamp=$venv/.surgicai-vision-setup
minimum_gb=8

: "${HOME:=/nonexistent}"

say() { printf 'setup: %s\n' "$*"; }
stop() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# The prefix that makes a command run as root: empty for root, "sudo -n" where sudo asks nothing.
if [ "$(id -u)" = 0 ]; then
    as_root=env
elif sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    as_root=
fi

# apt_install REASON PACKAGE...: install Debian packages, or stop with the one line that does it.
apt_install() {
    reason=$1
    shift
    line="apt-get install --yes --no-install-recommends $*"
    command -v apt-get >/dev/null 2>&1 || stop "$reason. This is not Debian or Ubuntu: install the equivalent of: $*"
    [ -n "$as_root" ] || stop "$reason. Run: sudo $line"
    say "$reason: $line"
    log=$(mktemp)
    {
        $as_root apt-get -o DPkg::Lock::Timeout=300 update &&
            $as_root env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 \
                install --yes --no-install-recommends "$@"
    } >"$log" 2>&1 </dev/null || { tail -n 20 "$log" >&2; stop "failed: sudo $line"; }
    rm -f "$log"
}

# Candidates are run, never trusted by name: a pyenv shim exists and fails, and a Python built without lzma
# or ssl cannot read a dataset.
python_works() {
    "$1" -c 'import sys
assert (3, 12) <= sys.version_info[:2] <= (3, 13) and sys.implementation.name == "cpython"
import bz2, ctypes, lzma, sqlite3, ssl' >/dev/null 2>&1
}

find_python() {
    for candidate in ${PYTHON:+"$PYTHON"} python3.12 python3.13 python3 python \
        "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[23]*/bin/python /usr/local/bin/python3.1[23] \
        /opt/*/bin/python3.1[23] "$HOME"/.local/share/uv/python/cpython-3.1[23]*/bin/python; do
        if python_works "$candidate"; then
            "$candidate" -c 'import sys; print(sys.executable)'
            return 0
        fi
    done
    return 1
}

find_uv() {
    for candidate in ${UV:+"$UV"} uv "$tools/bin/uv" "$HOME/.local/bin/uv" "$HOME/.cargo/bin/uv"; do
        if "$candidate" --version 2>/dev/null | grep -q '^uv '; then
            command -v "$candidate"
            return 0
        fi
    done
    return 1
}

# `pip --target` leaves the system's Python alone (PEP 668 permits it); `venv` serves where pip is missing.
uv_from() {
    rm -rf "$tools"
    maker=$1
    set -- install --quiet --disable-pip-version-check --no-deps --require-hashes -r scripts/uv.txt
    if "$maker" -m pip --version >/dev/null 2>&1; then
        PIP_REQUIRE_VIRTUALENV=0 PIP_ROOT_USER_ACTION=ignore "$maker" -m pip "$@" --target "$tools"
    else
        "$maker" -m venv "$tools" && "$tools/bin/python" -m pip "$@"
    fi && "$tools/bin/uv" --version >/dev/null || stop "uv could not be installed (see above); install it by any means and run this again"
}

install_uv() {
    say "uv is missing: installing $(sed -n 's/^\(uv==[^ ;]*\).*/\1/p' scripts/uv.txt) in .venv-tools"
    for attempt in first second; do
        for maker in ${python:+"$python"} python3 /usr/bin/python3; do
            if "$maker" -c 'import pip' 2>/dev/null || "$maker" -c 'import ensurepip, venv' 2>/dev/null; then
                uv_from "$maker"
                return 0
            fi
        done
        [ "$attempt" = first ] && apt_install "python3 has neither pip nor venv" python3-venv
    done
    stop "python3 has neither pip nor venv; install uv by any means and run this again"
}

# uv keeps what it downloads at home; where nothing can be written there, beside itself.
keep_cache_here() {
    [ -z "${UV_CACHE_DIR:-}" ] || return 0
    if [ -d "$HOME" ] && mkdir -p "${XDG_CACHE_HOME:-$HOME/.cache}/uv" 2>/dev/null &&
        [ -w "${XDG_CACHE_HOME:-$HOME/.cache}/uv" ]; then
        return 0
    fi
    say "the home folder cannot be written: downloads are kept in .venv-tools"
    export UV_CACHE_DIR="$tools/cache" UV_PYTHON_INSTALL_DIR="$tools/python"
}

check_gl() {
    python3 scripts/gl_probe.py >/dev/null 2>&1 && return 0
    apt_install "no OpenGL renders here ($(python3 scripts/gl_probe.py 2>&1 | tail -n 1))" libegl1 libgl1
    python3 scripts/gl_probe.py >/dev/null || stop "libegl1 and libgl1 are installed and GL still does not render."
}

check_space() {
    free_kb=$(df -Pk "$root" | awk 'NR == 2 { print $4 }')
    [ "$free_kb" -ge $((minimum_gb * 1024 * 1024)) ] ||
        say "warning: $((free_kb / 1024 / 1024)) GB free in $root; the environment takes about 6 GB"
}

make_venv() {
    python_works "$venv/bin/python" && return 0
    check_space
    if [ -n "$python" ]; then
        say "Python: $python"
        "$uv" venv --quiet --clear --python "$python" "$venv"
    else
        say "no Python 3.12 or 3.13 runs here: uv fetches one"
        "$uv" venv --quiet --clear --python 3.12 --python-preference only-managed "$venv" ||
            stop "uv could not fetch Python 3.12. Install Python 3.12 or 3.13 and run: PYTHON=/path/to/python make setup"
    fi
    # For packages of one's own (docs/extending.md); Debian keeps ensurepip in a package of its own.
    "$venv/bin/python" -m ensurepip --default-pip >/dev/null 2>&1 ||
        say "$("$venv/bin/python" --version) has no ensurepip: .venv gets no pip"
}

install_packages() {
    say "installing $(grep -c '==' requirements.lock) locked packages in .venv (about 6 GB on disk, once)"
    "$uv" pip install --quiet --python "$venv/bin/python" --no-deps --require-hashes -r requirements.lock
    "$uv" pip install --quiet --python "$venv/bin/python" --no-deps --no-build-isolation \
        --editable . --editable ./lerobot_env_surgicai --editable ./lerobot_robot_dvrk \
        --editable ./lerobot_salvage
}

command -v python3 >/dev/null 2>&1 || stop "python3 is missing; any version does. Run: sudo apt-get install --yes python3"
check_gl

wanted=$({ cat requirements.lock pyproject.toml lerobot_env_surgicai/pyproject.toml lerobot_robot_dvrk/pyproject.toml \
    lerobot_salvage/pyproject.toml scripts/setup.sh; printf '%s\n' "$root"; } | sha256sum | cut -d' ' -f1)
if [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ] && python_works "$venv/bin/python"; then
    exit 0
fi

python=$(find_python) || python=
uv=$(find_uv) || { install_uv; uv=$tools/bin/uv; }
keep_cache_here
make_venv
rm -f "$stamp"
install_packages
printf '%s\n' "$wanted" >"$stamp"
say "done: the commands stand in .venv/bin; 'make quickstart' runs the main job, '.venv/bin/surgicai-vision doctor' looks at this machine"
