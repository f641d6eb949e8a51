#!/bin/sh
# Make the virtual environment .venv with tubepose and its test tools, and install the system packages that it needs
# where they are missing (Debian and Ubuntu). Done again only when pyproject.toml or this file has changed.
set -eu
cd "$(dirname "$0")"

# Shared libraries that the wheel of Open3D expects of the system.
LIBRARIES="libegl1 libgl1 libusb-1.0-0"

fail() {
    echo "setup: $1" >&2
    exit 1
}

# Install the named Debian packages that are missing, as root or through sudo.
install_packages() {
    missing=""
    for package in "$@"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing="$missing $package"
    done
    [ -n "$missing" ] || return 0
    if [ "$(id -u)" = 0 ]; then
        as_root=""
    elif command -v sudo >/dev/null 2>&1; then
        as_root="sudo"
    else
        fail "missing system packages; as root run: apt-get install$missing"
    fi
    echo "setup: installing$missing"
    # The lists of a fresh machine are empty; an update that fails on one source need not stop the others.
    $as_root apt-get update -q || true
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $missing ||
        fail "apt-get failed; run: apt-get install$missing"
}

find_python() {
    for name in ${PYTHON:-} python3.13 python3.12 python3.11 python3; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$name"
            return 0
        fi
    done
    return 1
}

if command -v apt-get >/dev/null 2>&1; then
    install_packages $LIBRARIES
    find_python >/dev/null || install_packages python3
fi
python=$(find_python) || fail "no Python 3.11 or newer found; install one, or name it: make setup PYTHON=/path/to/python3"
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    command -v apt-get >/dev/null 2>&1 || fail "$python has no venv module; install it"
    # Debian ships venv apart, one package per version of Python.
    install_packages "$("$python" -c 'import sys; print("python3.%d-venv" % sys.version_info[1])')"
fi

[ -x .venv/bin/python ] || "$python" -m venv .venv
echo "setup: installing the Python packages into .venv (about 1.5 GB; some minutes)"
.venv/bin/python -m pip install --quiet --upgrade --editable ".[dev]" ||
    fail "pip could not install the dependencies; see its message above"
# Programs whose recordings the tests read; the tests are skipped where there is no wheel of them.
.venv/bin/python -m pip install --quiet --upgrade --editable ".[writers]" ||
    echo "setup: no RealSense or Foxglove SDK for this Python; the tests of their own recordings are skipped" >&2
.venv/bin/python -c 'import cv2, onnxruntime, open3d, tubepose, tubepose_cli' ||
    fail "the environment does not import; install the library that is named above"
touch .venv/.ready
