//! Other programs, kept running in a Python process so that their start-up is not timed.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// The process that runs `peers.py`; `None` where there is no Python.
pub struct Peers(Option<(Child, ChildStdin, BufReader<ChildStdout>)>);

impl Peers {
    /// Starts it, OpenMP with as many threads as we have.
    pub fn start() -> Self {
        let here = Path::new(env!("CARGO_MANIFEST_DIR"));
        let python =
            std::env::var_os("DIVFF_PYTHON").map_or_else(|| here.join("../.venv/bin/python"), PathBuf::from);
        let threads = rayon::current_num_threads().to_string();
        let child = Command::new(&python)
            .arg(here.join("benches/peers.py"))
            .env("OMP_NUM_THREADS", threads)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn();
        let Ok(mut child) = child else {
            eprintln!("{} does not start: nothing to compare with", python.display());
            return Self(None);
        };
        let pipes = child.stdin.take().zip(child.stdout.take()).expect("both are piped");
        Self(Some((child, pipes.0, BufReader::new(pipes.1))))
    }

    /// Seconds of a job and bytes of its file; `None` where the program is not installed or fails.
    pub fn time(&mut self, job: &str, format: &str, path: &Path) -> Option<(f64, u64)> {
        let (_, stdin, stdout) = self.0.as_mut()?;
        writeln!(stdin, "{job} {format} {}", path.display()).ok()?;
        let mut answer = String::new();
        stdout.read_line(&mut answer).ok()?;
        let numbers = answer.trim_end().split_once(' ')?;
        let times = numbers.0.parse().ok().zip(numbers.1.parse().ok());
        if times.is_none() {
            eprintln!("{format}: {answer}");
        }
        times
    }
}

impl Drop for Peers {
    fn drop(&mut self) {
        if let Some((mut child, stdin, _)) = self.0.take() {
            // The end of its input ends it.
            drop(stdin);
            let _ = child.wait();
        }
    }
}
