#!/usr/bin/env bash
# Our text encoders against PyTorch's. Apart from tests/test.sh because PyTorch takes 5.5 GB and the models 1.4 GB; run it
# after a change of src/semantics/text, scripts/export_text_encoders.py or the versions of rten and tokenizers.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

tests/tools/setup_text.sh
cargo test --locked --release --test text_encoders -- --include-ignored
