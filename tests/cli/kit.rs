//! Runs the program on a tiny scene.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// Settings under which a run takes a few seconds.
pub const TINY: &str = "
[train]
steps = 400
rays = 1024
# Long enough that the small fields of what moves do not explain what stays.
static_until = 0.6
samples = 12
render_samples = 16
grid_cells = 32.0
[field]
persistent = { levels = 4, log2_rows = 11, finest = 48.0, hidden = 16 }
dynamic = { levels = 3, log2_rows = 10, finest = 24.0, hidden = 16 }
actor = { levels = 3, log2_rows = 10, finest = 24.0, hidden = 16 }
[map]
voxel_size = 0.1
points = 1000
depth_rays = 20000
depth_samples = 16
times = \"frame:4\"
[semantics]
steps = 60
rays = 512
cached_rays = 8000
joint_steps = 10
hidden = 16
persistent = { levels = 3, coarsest = 4.0, finest = 16.0, log2_rows = 12, time_levels = 0, time_finest = 0.0 }
dynamic = { levels = 2, coarsest = 4.0, finest = 16.0, log2_rows = 12, time_levels = 1, time_finest = 8.0 }
actor = { levels = 2, coarsest = 4.0, finest = 8.0, log2_rows = 12, time_levels = 1, time_finest = 8.0 }
[semantics.compress]
dim = 16
";

/// What a command did.
pub struct Done {
    pub code: Option<i32>,
    pub out: String,
    pub err: String,
}

impl Done {
    /// Standard output of a command that must have succeeded.
    pub fn ok(self) -> String {
        assert_eq!(self.code, Some(0), "{}\n{}", self.out, self.err);
        self.out
    }

    /// The one message of a command that must have failed with `code`; it holds all of `parts`.
    pub fn fails(self, code: i32, parts: &[&str]) -> String {
        assert_eq!(self.code, Some(code), "{}\n{}", self.out, self.err);
        let messages: Vec<&str> = self.err.lines().filter(|l| l.starts_with("error: ")).collect();
        assert_eq!(messages.len(), 1, "one message: {}", self.err);
        assert!(!self.err.contains("panicked"), "{}", self.err);
        for part in parts {
            assert!(messages[0].contains(part), "`{part}` is not in: {}", messages[0]);
        }
        messages[0].to_owned()
    }
}

impl Done {
    /// A command line that is refused as such, with a message that holds `part`.
    pub fn usage(self, part: &str) {
        assert_eq!(self.code, Some(2), "{}\n{}", self.out, self.err);
        assert!(self.err.starts_with("error: ") && self.err.contains(part), "{}", self.err);
    }
}

/// Runs `divff` with some arguments.
pub fn divff(arguments: &[&str]) -> Done {
    finish(Command::new(env!("CARGO_BIN_EXE_divff")).args(arguments))
}

/// Runs a command to its end.
pub fn finish(command: &mut Command) -> Done {
    let output = command.stdin(Stdio::null()).output().expect("the program starts");
    let text = |bytes| String::from_utf8(bytes).expect("messages are UTF-8");
    Done { code: output.status.code(), out: text(output.stdout), err: text(output.stderr) }
}

/// A folder for one test, empty; it stays for a look until the test runs again.
pub fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cli").join(name);
    if folder.exists() {
        std::fs::remove_dir_all(&folder).unwrap();
    }
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// A path as an argument.
pub fn arg(path: &Path) -> &str {
    path.to_str().expect("the paths of the tests are UTF-8")
}

/// A tiny scene with ground truth, made once by `divff synth`.
pub fn scene() -> &'static Path {
    static SCENE: OnceLock<PathBuf> = OnceLock::new();
    SCENE.get_or_init(|| {
        let scene = folder("scene");
        divff(&["synth", "--out", arg(&scene), "--frames", "16", "--width", "48", "--height", "28"]).ok();
        scene
    })
}

/// A file with [`TINY`] settings.
pub fn tiny() -> &'static Path {
    static FILE: OnceLock<PathBuf> = OnceLock::new();
    FILE.get_or_init(|| {
        let path = folder("settings").join("tiny.toml");
        std::fs::write(&path, TINY).unwrap();
        path
    })
}

/// A finished run on [`scene`], made once; tests must not change it.
pub fn run() -> &'static Path {
    static RUN: OnceLock<PathBuf> = OnceLock::new();
    RUN.get_or_init(|| {
        let run = folder("run");
        divff(&["run", arg(scene()), "--out", arg(&run), "--config", arg(tiny()), "--threads", "2"]).ok();
        run
    })
}

/// Names of all files below a folder, relative to it, sorted.
pub fn files(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        let Ok(entries) = std::fs::read_dir(next) else { continue };
        for path in entries.map(|e| e.unwrap().path()) {
            match path.is_dir() {
                true => open.push(path),
                false => found.push(path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned()),
            }
        }
    }
    found.sort();
    found
}

/// Checks that two folders hold the same files with the same bytes, and at least one.
pub fn assert_same_files(a: &Path, b: &Path) {
    assert_eq!(files(a), files(b));
    assert!(!files(a).is_empty(), "{} is empty", a.display());
    for name in files(a) {
        let same = std::fs::read(a.join(&name)).unwrap() == std::fs::read(b.join(&name)).unwrap();
        assert!(same, "{name} differs between {} and {}", a.display(), b.display());
    }
}

/// Copies a folder.
pub fn copy(from: &Path, to: &Path) {
    for name in files(from) {
        let target = to.join(&name);
        std::fs::create_dir_all(target.parent().unwrap()).unwrap();
        std::fs::copy(from.join(&name), target).unwrap();
    }
}
