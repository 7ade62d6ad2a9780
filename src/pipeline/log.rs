//! `log.jsonl`: one line per progress report, so that a run can be followed and its curve drawn.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use divff_exporters::atomic::write_bytes_atomically;

use super::PipelineError;
use crate::error::FileError;
use crate::train::Progress;

/// The open log of a training session.
pub struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    /// Opens the log of a run that goes on after `step`: lines of later steps, which a crash after the last checkpoint
    /// leaves, are dropped. Step 0 starts an empty log.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub fn resume(path: &Path, step: u64) -> Result<Self, PipelineError> {
        let mut kept = Vec::new();
        if step > 0 {
            for line in read(path)?.into_iter().filter(|l| l.step <= step) {
                kept.extend(to_bytes(path, &line)?);
            }
        }
        write_bytes_atomically(path, &kept)?;
        let file = OpenOptions::new().append(true).open(path);
        let file = file.map_err(FileError::at(path))?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Adds a line; it is on its way to the disk when this returns.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn add(&mut self, progress: &Progress) -> Result<(), PipelineError> {
        let line = to_bytes(&self.path, progress)?;
        Ok(self.file.write_all(&line).map_err(FileError::at(&self.path))?)
    }
}

/// All lines of a log that can be read; none where there is no log. A last line that was cut off is left out.
///
/// # Errors
/// The file is there but cannot be read.
pub fn read(path: &Path) -> Result<Vec<Progress>, PipelineError> {
    let text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(source) => return Err(FileError::at(path)(source).into()),
    };
    Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect())
}

fn to_bytes(path: &Path, line: &Progress) -> Result<Vec<u8>, PipelineError> {
    let mut bytes = serde_json::to_vec(line).map_err(|e| FileError::at(path)(e.into()))?;
    bytes.push(b'\n');
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(step: u64) -> Progress {
        Progress {
            step,
            fraction: 0.5,
            seconds: 1.0,
            loss: 0.25,
            psnr: 20.0,
            test_psnr: None,
            rays_per_second: 1e5,
            samples_per_second: 1e6,
        }
    }

    #[test]
    fn resuming_drops_what_came_after_the_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        let mut log = Log::resume(&path, 0).unwrap();
        for step in [50, 100, 150] {
            log.add(&progress(step)).unwrap();
        }
        log.file.write_all(b"{\"step\": 20").unwrap();
        let steps = |path: &Path| read(path).unwrap().iter().map(|l| l.step).collect::<Vec<_>>();
        assert_eq!(steps(&path), [50, 100, 150]);
        Log::resume(&path, 100).unwrap().add(&progress(150)).unwrap();
        assert_eq!(steps(&path), [50, 100, 150]);
        drop(Log::resume(&path, 0).unwrap());
        assert!(steps(&path).is_empty());
    }
}
