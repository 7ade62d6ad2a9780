//! bench
fn main() { divff::bench_mlp() }
