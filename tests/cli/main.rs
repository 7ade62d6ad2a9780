//! The `divff` program from outside: what every command makes, says and returns.

mod bench;
mod broken_features;
mod broken_input;
mod commands;
mod features;
mod kit;
mod resuming;
mod skipping;
