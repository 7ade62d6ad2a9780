//! Large files written and read: seconds, MB/s, the ratio to one plain write or read of the same bytes, and to other
//! programs, all measured in turn; beside each ratio its bar.
//!
//! `cargo bench --package divff-exporters --bench files [ply|glb|exr]`. Each job runs in two folders: one in memory,
//! where syncing costs nothing (`/dev/shm`, or `DIVFF_MEMORY_FOLDER`), and the temporary folder, where our writers and the
//! plain write sync the file and the others do not. Other programs run under `DIVFF_PYTHON`, else `.venv/bin/python`;
//! without them their columns are left out.

#[path = "files/peers.rs"]
mod peers;

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use divff_exporters::{
    Attribute, AttributeValues, ExrChannel, ExrImage, ExrSamples, Geometry, GlbOptions, PlyOptions, read_exr,
    read_glb, read_ply, write_exr, write_glb, write_ply,
};
use half::f16;
use peers::Peers;

const ROUNDS: usize = 5;

/// What must hold; ratios of seconds. A bar of `None` is only reported.
struct Bars {
    /// A write takes at most so many plain writes (in memory, where nothing is synced).
    plain_write: Option<f64>,
    /// The other program's write takes at least so many of ours.
    peer_write: Option<f64>,
    /// The other program's read takes at least so many of ours.
    peer_read: Option<f64>,
}

/// A format, and its large file.
struct Job<'a> {
    format: &'static str,
    what: &'static str,
    peer: &'static str,
    bars: Bars,
    /// Bytes that MB/s refer to, where they are not the file's.
    content_bytes: Option<usize>,
    write: &'a dyn Fn(&Path),
    read: &'a dyn Fn(&Path),
}

fn main() {
    let chosen: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with('-')).collect();
    let is_chosen = |format: &str| chosen.is_empty() || chosen.iter().any(|word| word == format);
    println!("{} threads, medians of {ROUNDS} rounds in turn", rayon::current_num_threads());
    if is_chosen("ply") {
        ply();
    }
    if is_chosen("glb") {
        glb();
    }
    if is_chosen("exr") {
        exr();
    }
}

fn ply() {
    let cloud = cloud(1_000_000, 34);
    run(&Job {
        format: "ply",
        what: "1 M points, normals, colours, 34 attributes",
        peer: "Open3D",
        bars: Bars { plain_write: Some(3.0), peer_write: Some(10.0), peer_read: Some(5.0) },
        content_bytes: None,
        write: &|path| write_ply(path, &cloud, &PlyOptions::default()).expect("the folder is writable"),
        read: &|path| assert_eq!(read_ply(path).expect("just written").positions.len(), 1_000_000),
    });
}

fn glb() {
    const SIDE: usize = 1000;
    let mut mesh = Geometry { normals: vec![], colors: vec![], ..cloud(SIDE * SIDE, 1) };
    mesh.triangles = (0..SIDE * SIDE)
        .flat_map(|v| {
            let corner = |dx, dy| ((v / SIDE + dy) % SIDE * SIDE + (v + dx) % SIDE) as u32;
            [[corner(0, 0), corner(1, 0), corner(1, 1)], [corner(0, 0), corner(1, 1), corner(0, 1)]]
        })
        .collect();
    run(&Job {
        format: "glb",
        what: "1 M vertices, 2 M triangles, one attribute",
        peer: "trimesh",
        bars: Bars { plain_write: None, peer_write: Some(5.0), peer_read: None },
        content_bytes: None,
        write: &|path| write_glb(path, &mesh, &GlbOptions::default()).expect("the folder is writable"),
        read: &|path| assert_eq!(read_glb(path).expect("just written").geometries.len(), 1),
    });
}

fn exr() {
    const CHANNELS: usize = 512;
    let image = picture(456, 256, CHANNELS);
    run(&Job {
        format: "exr",
        what: "456×256 px, 512 half channels, ZIP",
        peer: "OpenEXR",
        bars: Bars { plain_write: None, peer_write: Some(1.5), peer_read: None },
        content_bytes: Some(2 * 456 * 256 * CHANNELS),
        // The writer takes the picture by value; copying its 120 MB is part of the time.
        write: &|path| write_exr(path, image.clone()).expect("the folder is writable"),
        read: &|path| assert_eq!(read_exr(path).expect("just written").channels.len(), CHANNELS),
    });
}

fn run(job: &Job) {
    let memory = std::env::var_os("DIVFF_MEMORY_FOLDER").map_or("/dev/shm".into(), PathBuf::from);
    let folders = [(memory, false), (std::env::temp_dir(), true)];
    for (folder, synced) in folders.into_iter().filter(|(folder, _)| folder.is_dir()) {
        let folder = tempfile::tempdir_in(folder).expect("a folder for the files");
        println!("\n{}: {}; {}", job.format, job.what, if synced { "on disk, synced" } else { "in memory" });
        measure(job, folder.path(), synced);
    }
}

/// Seconds of each round.
#[derive(Default)]
struct Times {
    ours: Vec<f64>,
    plain: Vec<f64>,
    peer: Vec<f64>,
}

fn measure(job: &Job, folder: &Path, synced: bool) {
    let names = ["ours", "plain", "peer"].map(|name| folder.join(format!("{name}.{}", job.format)));
    let [ours, plain, peer] = &names;
    (job.write)(ours);
    let bytes = fs::read(ours).expect("just written");
    let mut peers = Peers::start();
    let has_peer = peers.time("load", job.format, ours).is_some();
    let (mut writes, mut reads) = (Times::default(), Times::default());
    let mut peer_bytes = 0;
    for _ in 0..ROUNDS {
        for path in &names {
            // A file that is replaced has to be freed first, which is not what is measured.
            let _ = fs::remove_file(path);
        }
        writes.plain.push(seconds(|| plain_write(plain, &bytes, synced)));
        writes.ours.push(seconds(|| (job.write)(ours)));
        reads.plain.push(seconds(|| plain_read(plain)));
        reads.ours.push(seconds(|| (job.read)(ours)));
        if has_peer {
            let (seconds, bytes) = peers.time("write", job.format, peer).expect("it answered before");
            writes.peer.push(seconds);
            peer_bytes = bytes;
            reads.peer.extend(peers.time("read", job.format, peer).map(|(seconds, _)| seconds));
        }
    }
    println!("  {:.1} MB; {}'s file {:.1} MB", bytes.len() as f64 / 1e6, job.peer, peer_bytes as f64 / 1e6);
    let content = job.content_bytes.unwrap_or(bytes.len());
    let plain_bar = job.bars.plain_write.filter(|_| !synced);
    report("write", job, content, writes, plain_bar, job.bars.peer_write.filter(|_| !synced));
    report("read", job, content, reads, None, job.bars.peer_read);
}

fn report(what: &str, job: &Job, bytes: usize, times: Times, plain_bar: Option<f64>, peer_bar: Option<f64>) {
    let [ours, plain, peer] = [times.ours, times.plain, times.peer].map(spread);
    let Some([median, low, high]) = ours else { return };
    let rate = bytes as f64 / median / 1e6;
    println!("  {what:5} {median:.3} s ({low:.3} to {high:.3}), {rate:.0} MB/s");
    if let Some([seconds, ..]) = plain {
        let bar = plain_bar.map_or(String::new(), |bar| format!(" (bar: at most {bar})"));
        println!("        a plain {what} {seconds:.3} s: {:.2} of it{bar}", median / seconds);
    }
    if let Some([seconds, ..]) = peer {
        let bar = peer_bar.map_or(String::new(), |bar| format!(" (bar: at least {bar})"));
        println!("        {} {seconds:.3} s: {:.2} × as fast{bar}", job.peer, seconds / median);
    }
}

/// Median, least and most.
fn spread(mut seconds: Vec<f64>) -> Option<[f64; 3]> {
    seconds.sort_by(f64::total_cmp);
    Some([seconds[..].get(seconds.len() / 2)?, seconds.first()?, seconds.last()?].map(|v| *v))
}

fn seconds(job: impl FnOnce()) -> f64 {
    let start = Instant::now();
    job();
    start.elapsed().as_secs_f64()
}

fn plain_write(path: &Path, bytes: &[u8], sync: bool) {
    let mut file = File::create(path).expect("the folder is writable");
    file.write_all(bytes).expect("there is room");
    if sync {
        file.sync_all().expect("there is room");
    }
}

/// Into new memory, as every reader has to.
fn plain_read(path: &Path) {
    let mut bytes = Vec::new();
    File::open(path).and_then(|mut file| file.read_to_end(&mut bytes)).expect("just written");
    std::hint::black_box(bytes);
}

/// Numbers in [0, 1), the same in every run (SplitMix64).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    }
}

fn cloud(vertices: usize, attributes: usize) -> Geometry {
    let mut numbers = Numbers(1);
    let mut next = || numbers.next();
    let attribute = |a: usize| Attribute {
        name: format!("score{a}"),
        values: AttributeValues::F32((0..vertices).map(|_| next()).collect()),
    };
    let attributes = (0..attributes).map(attribute).collect();
    let mut triple = || [next(), next(), next()];
    Geometry {
        name: "points".into(),
        positions: (0..vertices).map(|_| triple()).collect(),
        normals: (0..vertices).map(|v| [(v as f32).cos(), (v as f32).sin(), 0.0]).collect(),
        colors: (0..vertices).map(|_| triple().map(|v| (255.0 * v) as u8)).collect(),
        attributes,
        ..Geometry::default()
    }
}

/// A smooth signal with noise of 2 %.
fn picture(width: usize, height: usize, channels: usize) -> ExrImage {
    let mut numbers = Numbers(2);
    let mut channel = |c: usize| {
        let samples = (0..width * height).map(|pixel| {
            let (u, v) = ((pixel % width) as f32 / width as f32, (pixel / width) as f32 / height as f32);
            let smooth = (6.0 * u + 0.1 * c as f32).sin() * (4.0 * v + 0.2 * c as f32).cos();
            f16::from_f32(smooth + 0.02 * (2.0 * numbers.next() - 1.0))
        });
        ExrChannel { name: format!("clip_{c:03}.R"), samples: ExrSamples::F16(samples.collect()) }
    };
    ExrImage { width, height, channels: (0..channels).map(&mut channel).collect() }
}
