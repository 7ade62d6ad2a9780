//! What other programs take for the same work, where a Python with them is at hand.
//!
//! `DIVFF_PYTHON` names the interpreter. Nothing of ours needs it.

use std::path::Path;
use std::process::{Command, Stdio};

use super::table::Cell;

/// Prints the least seconds of three calls of `job`.
const TIMER: &str = "
import time
def least(job):
    times = []
    for _ in range(3):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return min(times)
";

/// Runs a Python script, which finds `arguments` in `sys.argv` and may call `least(job)`; the number that it prints last.
///
/// # Errors
/// `not installed` without an interpreter or a package, else what Python says last.
pub fn seconds(script: &str, arguments: &[&Path]) -> Result<f64, String> {
    let absent = || "not installed".to_owned();
    let python = std::env::var_os("DIVFF_PYTHON").ok_or_else(absent)?;
    let mut command = Command::new(python);
    command.arg("-c").arg(format!("{TIMER}{script}")).args(arguments).stdin(Stdio::null());
    let output = command.output().map_err(|_| absent())?;
    let last = |bytes: &[u8]| {
        String::from_utf8_lossy(bytes).lines().rfind(|l| !l.trim().is_empty()).unwrap_or_default().to_owned()
    };
    if !output.status.success() {
        let said = last(&output.stderr);
        return Err(if said.contains("No module named") { absent() } else { said });
    }
    last(&output.stdout).trim().parse().map_err(|_| "it printed no number".to_owned())
}

/// How many times as long the peer takes as our `ours` seconds.
pub fn ratio(script: &str, arguments: &[&Path], ours: f64) -> Cell {
    match seconds(script, arguments) {
        Ok(theirs) => Cell::Number(theirs / ours.max(1e-9)),
        Err(why) => Cell::Missing(why),
    }
}

/// Marching cubes of a grid in a `.npy` file, at level 0.
pub const SKIMAGE_MARCH: &str = "
import sys, numpy
from skimage.measure import marching_cubes
grid = numpy.load(sys.argv[1])
start = time.perf_counter()
marching_cubes(grid, 0.0)
print(time.perf_counter() - start)
";

/// Writes a point cloud once more.
pub const OPEN3D_PLY: &str = "
import sys, open3d
cloud = open3d.t.io.read_point_cloud(sys.argv[1])
print(least(lambda: open3d.t.io.write_point_cloud(sys.argv[2], cloud)))
";

/// Writes a PLY file once more.
pub const PLYFILE_PLY: &str = "
import sys, plyfile
data = plyfile.PlyData.read(sys.argv[1], mmap=False)
print(least(lambda: data.write(sys.argv[2])))
";

/// Writes a mesh once more, in the format of the second file.
pub const TRIMESH_MESH: &str = "
import sys, trimesh
mesh = trimesh.load(sys.argv[1], process=False)
print(least(lambda: mesh.export(sys.argv[2])))
";
