#!/usr/bin/env bash
# Makes what tests/text_encoders.rs needs: PyTorch in `.venv-text`, then text towers of the real architectures with random
# weights and PyTorch's embeddings of 200 phrases in `target/text-models` (1.3 GB). Does nothing when both are up to date;
# else takes about three minutes.
#
# PyTorch's own index has wheels for processors alone (1 GB of disk). Where it cannot be reached, PyPI's are taken, which
# on Linux bring CUDA's libraries and do not load without them (4.6 GB of disk).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
tools=tests/tools
venv=.venv-text
models=target/text-models

fail() {
    echo "setup_text.sh: $*" >&2
    exit 1
}

# Up to date: made from exactly these files, and complete (the stamp is written last).
is_current() { [ -f "$1" ] && [ "$(cat "$1")" = "$2" ]; }

install() {
    "$venv/bin/uv" pip install --quiet --no-cache --python "$venv/bin/python" --override "$tools/overrides-text.txt" \
        --requirement "$tools/requirements-text.txt" "$@"
}

reachable() {
    "$venv/bin/python" -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=10)' "$1" 2>/dev/null
}

wanted=$(sha256sum "$tools/requirements-text.txt" "$tools/overrides-text.txt")
if ! is_current "$venv/stamp" "$wanted"; then
    rm -rf "$venv"
    "${PYTHON:-python3}" -m venv "$venv" || fail "cannot make a virtual environment; is python3-venv installed?"
    # uv downloads and unpacks this in half a minute, pip in ten.
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check uv==0.13.9
    if ! { reachable https://download.pytorch.org/whl/cpu/torch/ && install --torch-backend cpu; }; then
        install
    fi
    "$venv/bin/python" -c 'import onnx, onnxscript, open_clip, torch, transformers' ||
        fail "a Python module does not load; the message above names what is missing"
    echo "$wanted" >"$venv/stamp"
fi

wanted=$(sha256sum "$tools/requirements-text.txt" "$tools/text_models.py" scripts/export_text_encoders.py)
if ! is_current "$models/stamp" "$wanted"; then
    rm -rf "$models"
    "$venv/bin/python" "$tools/text_models.py" "$models"
    echo "$wanted" >"$models/stamp"
fi
