#!/usr/bin/env bash
# Makes text towers of the real architectures with random weights, and what PyTorch says about 200 phrases, for
# tests/text_encoders.rs. Not part of tests/test.sh: PyTorch takes 6 GB where only its CUDA wheels are to be had (0.9 GB
# with `--index-url https://download.pytorch.org/whl/cpu` in PIP_ARGS), the models another 1.4 GB.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

if [ ! -f .venv-text/stamp ]; then
    rm -rf .venv-text
    "${PYTHON:-python3}" -m venv .venv-text
    # Unquoted on purpose: several arguments.
    .venv-text/bin/python -m pip install --quiet --disable-pip-version-check ${PIP_ARGS:-} \
        torch==2.15.0 open_clip_torch==3.3.0 transformers==5.23.0 onnx==1.23.2 onnxscript==0.7.2
    touch .venv-text/stamp
fi
.venv-text/bin/python tests/tools/text_models.py "${DIVFF_TEXT_MODELS:-target/text-models}"
