//! The plain geometry that is written and read: vertices, triangles and named columns.

/// One scalar per vertex, named as it appears in files: lower-case `[a-z][a-z0-9_]*`.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Slug; GLB writes it upper-case with a leading underscore, PLY and NPZ as it is.
    pub name: String,
    /// One value per vertex.
    pub values: AttributeValues,
}

/// Storage of one attribute. Only the three types that every reader keeps (PLY `float`, `int`, `uchar`).
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValues {
    /// PLY `float`, NPZ `<f4`, GLB SCALAR f32.
    F32(Vec<f32>),
    /// PLY `int`, NPZ `<i4`, GLB SCALAR f32 (exact to 2^24).
    I32(Vec<i32>),
    /// PLY `uchar`, NPZ `|u1`, GLB SCALAR f32.
    U8(Vec<u8>),
}

/// A feature vector per vertex, row-major `[vertices, dim]`, e.g. the (compressed) CLIP descriptor.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    /// Column prefix: `clip`, `clip_pca`, `egovideo`, ...
    pub name: String,
    /// Width of a row.
    pub dim: usize,
    /// `[vertices * dim]`.
    pub values: Vec<f32>,
}

/// A mesh, or a point cloud when `triangles` is empty.
///
/// Invariants (checked by every writer): all columns have one entry per vertex; triangle indices are in
/// range; every number is finite.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Geometry {
    /// Name of the object, e.g. `persistent` or `dynamic_000012`.
    pub name: String,
    /// World position minus `offset`, `[vertices]`.
    pub positions: Vec<[f32; 3]>,
    /// Subtracted from world coordinates so that f32 keeps its precision far from the origin; usually zero.
    pub offset: [f64; 3],
    /// Unit normals, `[vertices]` or empty.
    pub normals: Vec<[f32; 3]>,
    /// sRGB colours, `[vertices]` or empty.
    pub colors: Vec<[u8; 3]>,
    /// Vertex indices, counter-clockwise seen from outside; empty for a point cloud.
    pub triangles: Vec<[u32; 3]>,
    /// Scalar columns.
    pub attributes: Vec<Attribute>,
    /// Feature matrices.
    pub features: Vec<Features>,
}
