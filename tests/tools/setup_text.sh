#!/usr/bin/env bash
# Makes what tests/text_encoders.rs needs: PyTorch in `.venv-text` (5.5 GB on Linux, whose wheels bring CUDA's libraries),
# then text towers of the real architectures with random weights and PyTorch's embeddings of 200 phrases in
# `target/text-models` (1.4 GB). Does nothing when both are up to date.
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

wanted=$(sha256sum "$tools/requirements-text.txt")
if ! is_current "$venv/stamp" "$wanted"; then
    rm -rf "$venv"
    "${PYTHON:-python3}" -m venv "$venv" || fail "cannot make a virtual environment; is python3-venv installed?"
    # uv downloads and unpacks these 3 GB in about a minute, pip in ten.
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check uv==0.13.9
    "$venv/bin/uv" pip install --quiet --no-cache --python "$venv/bin/python" --requirement \
        "$tools/requirements-text.txt"
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
