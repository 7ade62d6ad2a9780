//! Small valid files of every kind that readers take.

use std::fs;
use std::io::{Cursor, Write};
use std::path::Path;

use divff_exporters::manifest::{
    AffordanceEntry, AttributeEntry, FORMAT_VERSION, FeatureEntry, FileEntry, MANIFEST_NAME, SkippedEntry,
    TimeInterval,
};
use divff_exporters::{
    Attribute, AttributeValues, ExrChannel, ExrImage, ExrSamples, Features, Geometry, GlbNode, GlbOptions,
    GlbScene, Interval, Manifest, NpzCompression, PlyOptions, write_exr, write_glb, write_npy, write_npz,
    write_ply, write_scene_glb,
};
use exr::prelude as x;
use exr::prelude::WritableImage;
use half::f16;

use crate::kit::Sample;

/// What `write` puts into a file.
fn written(write: impl FnOnce(&Path)) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("sample");
    write(&path);
    fs::read(path).expect("just written")
}

/// Every kind of column.
fn mesh() -> Geometry {
    let attribute = |name: &str, values| Attribute { name: name.into(), values };
    Geometry {
        name: "persistent".into(),
        positions: vec![[0.5, 0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [-0.5, -0.5, 0.5]],
        offset: [1.0e6, -2.5e6, 0.1],
        normals: vec![[0.0, 0.0, 1.0]; 4],
        colors: vec![[0, 1, 2], [127, 128, 129], [253, 254, 255], [10, 200, 30]],
        triangles: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
        attributes: vec![
            attribute("confidence", AttributeValues::F32(vec![0.0, 0.25, f32::MIN_POSITIVE, 1.0])),
            attribute("label", AttributeValues::I32(vec![-1, 0, 1 << 24, -(1 << 24)])),
            attribute("stream", AttributeValues::U8(vec![0, 1, 2, 255])),
        ],
        features: vec![Features {
            name: "clip".into(),
            dim: 6,
            values: (0..24).map(|v| v as f32 / 7.0).collect(),
        }],
    }
}

pub fn ply() -> Vec<Sample> {
    let own = written(|path| write_ply(path, &mesh(), &PlyOptions::default()).expect("a valid mesh"));
    let text = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 4\nproperty double x\nproperty double y\n\
        property double z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty ushort Object-Id\n\
        property float scalar_Heat\nelement camera 1\nproperty list uchar float focal\nelement face 1\n\
        property uchar flags\nproperty list uchar uint vertex_index\nend_header\n0 0 0 0 0 2 7 0.5\n\
        1 0 0 0 0 1 8 1\n1 1 0 0 0 1 9 1.5\n0 1 0 0 0 1 10 2\n2 1.5 2.5\n3 4 0 1 2 3\n";
    vec![
        Sample::plain("a binary mesh", own),
        Sample { needs_every_byte: false, ..Sample::plain("a mesh in text", text.into()) },
        Sample::plain("a big-endian mesh", big_endian_ply()),
    ]
}

/// Quads before the vertices, whose coordinates are doubles far from the origin.
fn big_endian_ply() -> Vec<u8> {
    let mut file =
        b"ply\nformat binary_big_endian 1.0\nelement face 1\nproperty list uchar int vertex_indices\n\
        element vertex 4\nproperty double x\nproperty double y\nproperty double z\nproperty uint id\n\
        property short level\nend_header\n"
            .to_vec();
    file.push(4);
    file.extend([0i32, 1, 2, 3].map(i32::to_be_bytes).concat());
    for v in 0..4u8 {
        let position = [5e6 + f64::from(v % 2), f64::from(v / 2), 0.0];
        file.extend(position.map(f64::to_be_bytes).concat());
        file.extend(u32::from(v).to_be_bytes());
        file.extend((-i16::from(v)).to_be_bytes());
    }
    file
}

pub fn glb() -> Vec<Sample> {
    let options = GlbOptions { features: true, unlit: true, ..GlbOptions::default() };
    let one = written(|path| write_glb(path, &mesh(), &options).expect("a valid mesh"));
    let scene = written(|path| {
        let geometries = [mesh(), Geometry { name: "dynamic_000001".into(), ..mesh() }];
        let interval = Some(Interval { time_start: 0.25, time_end: 0.5 });
        let nodes = vec![
            GlbNode { name: "persistent".into(), ..GlbNode::default() },
            GlbNode { name: "dynamic_000001".into(), geometry: 1, interval, ..GlbNode::default() },
        ];
        let scene = GlbScene { geometries: geometries.iter().collect(), nodes, seconds: 8.0 };
        write_scene_glb(path, &scene, &GlbOptions::default()).expect("a valid scene");
    });
    let scene = Sample::plain("a scene in time", scene);
    let inside =
        Sample { name: "the JSON and data of a mesh", wrap: wrap_glb, ..Sample::plain("", one.clone()) };
    vec![Sample::plain("a mesh with features", one), scene, inside]
}

/// Mends the three lengths of a GLB file: of the file, of the JSON up to the second chunk's type, and of the rest.
fn wrap_glb(mut file: Vec<u8>) -> Vec<u8> {
    let Some(bin_type) = file.windows(4).position(|word| word == b"BIN\0").filter(|at| *at >= 24) else {
        return file;
    };
    let lengths = [(8, file.len()), (12, bin_type - 24), (bin_type - 4, file.len() - bin_type - 4)];
    for (at, length) in lengths {
        file[at..at + 4].copy_from_slice(&(length as u32).to_le_bytes());
    }
    file
}

pub fn npz() -> Vec<Sample> {
    let packed = |compression| written(|path| write_npz(path, &mesh(), compression).expect("a valid mesh"));
    // The arrays one after the other, each before a mark, for wrap_npz.
    let small = Geometry { features: vec![], ..mesh() };
    let stored = written(|path| write_npz(path, &small, NpzCompression::Stored).expect("a valid mesh"));
    let mut archive = zip::ZipArchive::new(Cursor::new(stored)).expect("just written");
    let mut arrays = Vec::new();
    for index in 0..archive.len() {
        std::io::copy(&mut archive.by_index(index).expect("it is there"), &mut arrays).expect("into memory");
        arrays.extend(MARK);
    }
    let inside = Sample { name: "arrays in an archive", wrap: wrap_npz, ..Sample::plain("", arrays) };
    vec![
        Sample::plain("a stored archive", packed(NpzCompression::Stored)),
        Sample::plain("a deflated archive", packed(NpzCompression::Deflated)),
        inside,
    ]
}

const MARK: &[u8] = b"<end of array>";

/// An archive, whole in itself, of arrays that may be damaged.
fn wrap_npz(arrays: Vec<u8>) -> Vec<u8> {
    const NAMES: [&str; 7] = ["positions", "normals", "colors", "confidence", "label", "stream", "triangles"];
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    let mut rest = &arrays[..];
    for name in NAMES {
        let end = rest.windows(MARK.len()).position(|window| window == MARK).unwrap_or(rest.len());
        archive.start_file(format!("{name}.npy"), options).expect("into memory");
        archive.write_all(&rest[..end]).expect("into memory");
        rest = rest.get(end + MARK.len()..).unwrap_or_default();
    }
    archive.finish().expect("into memory").into_inner()
}

pub fn npy() -> Vec<Sample> {
    let floats =
        written(|path| write_npy(path, &[2, 3], &[1.0, -0.5, 2.0, 0.0, 7.0, 1e9]).expect("six values"));
    let with = |descr: &str, shape: &str, values: &[u8]| {
        let text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
        // Version 2, as numpy writes for long headers.
        let mut file = b"\x93NUMPY\x02\x00".to_vec();
        file.extend((text.len() as u32).to_le_bytes());
        file.extend(text.bytes());
        file.extend(values);
        file
    };
    vec![
        Sample::plain("floats", floats),
        Sample::plain("half floats", with("<f2", "(2, 2)", &[0, 60, 0, 188, 1, 0, 255, 123])),
        Sample::plain("64-bit integers", with("<i8", "(2,)", &[7; 16])),
    ]
}

pub fn exr() -> Vec<Sample> {
    let (width, height) = (19, 37);
    let half = |c: usize| (0..width * height).map(|p| f16::from_f32((p * (c + 1)) as f32 / 4000.0)).collect();
    let own = written(|path| {
        let channels = ["R", "clip_000.R"]
            .into_iter()
            .enumerate()
            .map(|(c, name)| ExrChannel { name: name.into(), samples: ExrSamples::F16(half(c)) });
        write_exr(path, ExrImage { width, height, channels: channels.collect() }).expect("a valid picture");
    });
    let others = [
        ("run-length coded lines", x::Compression::RLE, x::Blocks::ScanLines),
        ("wavelets", x::Compression::PIZ, x::Blocks::ScanLines),
        ("24-bit lines", x::Compression::PXR24, x::Blocks::ScanLines),
        ("fixed blocks", x::Compression::B44, x::Blocks::ScanLines),
        ("plain lines", x::Compression::Uncompressed, x::Blocks::ScanLines),
        ("tiles", x::Compression::ZIP1, x::Blocks::Tiles(x::Vec2(8, 16))),
    ];
    let others = others.map(|(name, compression, blocks)| {
        let depth = (0..width * height).map(|p| 0.1 + p as f32 * 1e-3).collect();
        let channels = x::AnyChannels::sort(smallvec_of(vec![
            x::AnyChannel::new("Z", x::FlatSamples::F32(depth)),
            x::AnyChannel::new("R", x::FlatSamples::F16(half(0))),
        ]));
        let encoding = x::Encoding { compression, blocks, line_order: x::LineOrder::Increasing };
        let layer = x::Layer::new((width, height), x::LayerAttributes::default(), encoding, channels);
        let mut file = Cursor::new(Vec::new());
        x::Image::from_layer(layer).write().to_buffered(&mut file).expect("into memory");
        Sample::plain(name, file.into_inner())
    });
    [Sample::plain("our own form", own)].into_iter().chain(others).collect()
}

fn smallvec_of(
    channels: Vec<x::AnyChannel<x::FlatSamples>>,
) -> x::SmallVec<[x::AnyChannel<x::FlatSamples>; 4]> {
    channels.into_iter().collect()
}

pub fn manifest() -> Vec<Sample> {
    let json = written(|path| {
        // The manifest chooses its own name.
        let folder = tempfile::tempdir().expect("a temporary folder");
        let manifest = Manifest {
            format_version: FORMAT_VERSION,
            units: "metre".into(),
            source_id: "kitchen".into(),
            streams: vec!["persistent".into(), "dynamic".into()],
            time_intervals: vec![TimeInterval {
                name: "dynamic_000001".into(),
                stream: "dynamic".into(),
                time_start: 0.25,
                time_end: 0.5,
            }],
            attributes: vec![AttributeEntry { name: "label".into(), kind: "i32".into(), range: [-1.0, 7.0] }],
            features: vec![FeatureEntry {
                name: "clip".into(),
                dim: 6,
                dtype: "f32".into(),
                model: "ViT-B-16".into(),
                normalised: true,
                pca_file: Some("clip_pca.npz".into()),
            }],
            affordances: vec![AffordanceEntry { name: "wash".into(), prompts: vec!["a sink".into()] }],
            files: vec![FileEntry { path: "a.ply".into(), sha256: "00".into(), vertices: 4, faces: 4 }],
            skipped: vec![SkippedEntry { what: "actor".into(), why: "it is not there".into() }],
            ..Manifest::default()
        };
        manifest.write(folder.path()).expect("a valid manifest");
        fs::copy(folder.path().join(MANIFEST_NAME), path).expect("just written");
    });
    vec![Sample { needs_every_byte: false, ..Sample::plain("a manifest", json) }]
}
