//! The `divff` program from outside: what every command makes, says and returns.

mod broken_input;
mod commands;
mod kit;
mod resuming;
