#!/usr/bin/env bash
# The one test command: everything that must hold before a change goes in.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Optimised as in a release, but not across crates, for every test program would be optimised whole once more; and without lines
# for debuggers. Our own crate stays in one unit, since kernels that are not inlined take twice as long, which costs tests more
# than compiling in many units saves: the library and its tests are compiled side by side anyway. Half an hour in all.
export CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_DEBUG=none
# Where files are read, numbers that overflow and assertions that do not hold count as well.
profile=(--config profile.release.package.divff-exporters.overflow-checks=true)
profile+=(--config profile.release.package.divff-exporters.debug-assertions=true)

step() {
    echo
    echo "== $*"
}

free_gb=$(df -Pk . | awk 'NR == 2 { print int($4 / 1e6) }')
[ "$free_gb" -ge 20 ] || echo "!! $free_gb GB of disk are free; the first time, tools and builds take 20 GB"

step "tools that read our files"
tests/tools/setup.sh

step "PyTorch, and text encoders with random weights"
tests/tools/setup_text.sh

step "format"
cargo fmt --all --check

step "lints"
cargo clippy --workspace --all-targets --locked --release -- -D warnings

step "licences and sources of dependencies, and what is known against them"
deny=(cargo deny --all-features --locked)
if ! cargo deny --version 2> /dev/null; then
    echo "!! NOT CHECKED: cargo-deny is not installed (cargo install cargo-deny --locked)"
else
    "${deny[@]}" check licenses bans sources
    # Without a network the database cannot be had; what it says has to fail the run, that it is missing has not.
    if cargo deny fetch db; then
        "${deny[@]}" check advisories
    else
        echo "!! NOT CHECKED: known vulnerabilities, for the advisory database could not be fetched (see above)"
    fi
fi

step "documentation"
RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --locked --release

step "tests, release"
cargo test --workspace --locked --release "${profile[@]}"

step "a build without text encoders"
cargo clippy --package divff --lib --no-default-features --locked --release -- -D warnings

step "all passed"
