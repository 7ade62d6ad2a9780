#!/usr/bin/env bash
# Installs the programs that the tests read our files with: `.venv` (Python) and `node_modules` in the repository's
# root. Does nothing when both are up to date.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
tools=tests/tools

fail() {
    echo "setup.sh: $*" >&2
    exit 1
}

# Shared libraries that the wheels of Blender and Open3D expect from the system.
libraries=(libegl1 libgl1 libgomp1 libsm6 libusb-1.0-0 libx11-6 libxext6 libxfixes3 libxi6 libxkbcommon0
    libxrender1 libxxf86vm1)

install_libraries() {
    command -v dpkg-query >/dev/null || return 0 # Not Debian: importing below tells what is missing.
    local missing=()
    for library in "${libraries[@]}"; do
        dpkg-query -W -f '${Status}' "$library" 2>/dev/null | grep -q 'ok installed' || missing+=("$library")
    done
    [ ${#missing[@]} -gt 0 ] || return 0
    [ "$(id -u)" = 0 ] || fail "these packages are missing: apt-get install ${missing[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

find_python() {
    local candidate
    for candidate in "${PYTHON:-}" python3.11 python3; do
        [ -n "$candidate" ] || continue
        if [ "$("$candidate" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" = 3.11 ]; then
            echo "$candidate"
            return
        fi
    done
    fail "Python 3.11 is needed (Blender's module bpy 5.0 has wheels for no other); install it, e.g." \
        "\`apt-get install python3.11 python3.11-venv\` or \`uv python install 3.11\`, or set PYTHON to it"
}

# Up to date: made from exactly this list of packages, and complete (the stamp is written last).
is_current() { [ -f "$1" ] && [ "$(cat "$1")" = "$2" ]; }

install_libraries

wanted=$(sha256sum "$tools/requirements.txt")
if ! is_current .venv/stamp "$wanted"; then
    python=$(find_python)
    rm -rf .venv
    "$python" -m venv .venv || fail "cannot make a virtual environment; is python3.11-venv installed?"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --requirement "$tools/requirements.txt"
    .venv/bin/python -c 'import bpy, numpy, open3d, OpenEXR, PIL, scipy, trimesh' ||
        fail "a Python module does not load; the message above names the missing library"
    echo "$wanted" >.venv/stamp
fi

wanted=$(sha256sum "$tools/package-lock.json")
if ! is_current node_modules/stamp "$wanted"; then
    command -v npm >/dev/null || fail "Node.js 20.11 or later with npm is needed for the glTF validator"
    npm ci --prefix "$tools" --no-audit --no-fund --loglevel=error
    # The validator is found from the repository's root; the folder of scripts stays free of modules.
    rm -rf node_modules
    mv "$tools/node_modules" node_modules
    echo "$wanted" >node_modules/stamp
fi
