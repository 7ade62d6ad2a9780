//! Triangle meshes from boxes, turned profiles, tubes and ellipsoids.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Mat3, Vec2, Vec3};

use super::material::Material;

/// A corner of a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Vertex {
    pub position: Vec3,
    /// Shading normal, unit length.
    pub normal: Vec3,
    /// Where the solid texture is looked up: it stays with the object when it moves.
    pub texture: Vec3,
}

/// What a triangle belongs to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tag {
    pub instance: u16,
    pub material: Material,
}

/// A mesh under construction and afterwards; triangles wind counter-clockwise seen from outside.
#[derive(Clone, Debug, Default)]
pub(super) struct Mesh {
    pub vertices: Vec<Vertex>,
    pub triangles: Vec<[u32; 3]>,
    /// One per triangle.
    pub tags: Vec<Tag>,
}

impl Mesh {
    pub(super) fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|v| self.vertices[v as usize].position)
    }

    /// Appends a copy of `other` moved by `transform` (a rotation and a translation).
    pub(super) fn append(&mut self, other: &Self, transform: &Affine3A) {
        let base = self.vertices.len() as u32;
        self.vertices.extend(other.vertices.iter().map(|v| Vertex {
            position: transform.transform_point3(v.position),
            normal: transform.transform_vector3(v.normal),
            texture: v.texture,
        }));
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + base)));
        self.tags.extend_from_slice(&other.tags);
    }

    /// Adds a triangle, wound so that it faces the way its shading normals point; none without an area.
    fn triangle(&mut self, tag: Tag, mut corners: [u32; 3]) {
        let [a, b, c] = corners.map(|v| self.vertices[v as usize]);
        let area = (b.position - a.position).cross(c.position - a.position);
        if area.length_squared() < 1e-16 {
            return;
        }
        if area.dot(a.normal + b.normal + c.normal) < 0.0 {
            corners.swap(1, 2);
        }
        self.triangles.push(corners);
        self.tags.push(tag);
    }

    /// A grid of `rows * columns` vertices, row-major, joined by two triangles per cell.
    fn grid(&mut self, tag: Tag, columns: usize, vertices: impl IntoIterator<Item = Vertex>) {
        let base = self.vertices.len() as u32;
        self.vertices.extend(vertices);
        let rows = (self.vertices.len() - base as usize) / columns;
        for row in 0..rows as u32 - 1 {
            for column in 0..columns as u32 - 1 {
                let a = base + row * columns as u32 + column;
                let [b, c, d] = [a + 1, a + columns as u32, a + columns as u32 + 1];
                self.triangle(tag, [a, b, d]);
                self.triangle(tag, [a, d, c]);
            }
        }
    }

    /// A parallelogram that faces `u × v`.
    pub(super) fn quad(&mut self, tag: Tag, corner: Vec3, u: Vec3, v: Vec3) {
        let normal = u.cross(v).normalize();
        let vertex = |position| Vertex { position, normal, texture: position };
        self.grid(tag, 2, [corner, corner + u, corner + v, corner + u + v].map(vertex));
    }

    /// An axis-aligned box.
    pub(super) fn cuboid(&mut self, tag: Tag, min: Vec3, max: Vec3) {
        let d = max - min;
        let (x, y, z) = (Vec3::X * d.x, Vec3::Y * d.y, Vec3::Z * d.z);
        for (corner, u, v) in
            [(min, y, x), (min, x, z), (min, z, y), (max, -x, -y), (max, -z, -x), (max, -y, -z)]
        {
            self.quad(tag, corner, u, v);
        }
    }

    /// A surface of revolution about the vertical through `base`. `profile` holds (radius, height) pairs
    /// from the bottom outwards and up; what lies to the right of its direction is outside.
    pub(super) fn lathe(&mut self, tag: Tag, base: Vec3, profile: &[(f32, f32)], segments: usize) {
        for pair in profile.windows(2) {
            let ((r0, z0), (r1, z1)) = (pair[0], pair[1]);
            // Each band has its own normals, so that rims stay crisp.
            let slope = Vec2::new(z1 - z0, r0 - r1).normalize_or_zero();
            let ring = move |(r, z): (f32, f32)| {
                (0..=segments).map(move |i| {
                    let (sin, cos) = angle(i, segments).sin_cos();
                    let local = Vec3::new(r * cos, r * sin, z);
                    let normal = Vec3::new(slope.x * cos, slope.x * sin, slope.y);
                    Vertex { position: base + local, normal, texture: local }
                })
            };
            self.grid(tag, segments + 1, ring((r0, z0)).chain(ring((r1, z1))));
        }
    }

    /// A closed tube along `path`, with one radius per point.
    pub(super) fn tube(&mut self, tag: Tag, path: &[Vec3], radii: &[f32], segments: usize) {
        debug_assert!(path.len() == radii.len() && path.len() > 1);
        let last = path.len() - 1;
        let direction = |i: usize| (path[(i + 1).min(last)] - path[i.saturating_sub(1)]).normalize();
        let mut side = direction(0).any_orthonormal_vector();
        let mut along = 0.0;
        let mut rings = Vec::with_capacity(path.len() * (segments + 1));
        for i in 0..=last {
            let tangent = direction(i);
            side = (side - tangent * side.dot(tangent)).normalize();
            let up = tangent.cross(side);
            along += if i > 0 { path[i].distance(path[i - 1]) } else { 0.0 };
            rings.extend((0..=segments).map(|k| {
                let (sin, cos) = angle(k, segments).sin_cos();
                let normal = side * cos + up * sin;
                let texture = Vec3::new(cos * radii[i], sin * radii[i], along);
                Vertex { position: path[i] + normal * radii[i], normal, texture }
            }));
        }
        let caps = [(0, -direction(0)), (last, direction(last))];
        let ends = caps.map(|(i, normal)| {
            let ring = rings[i * (segments + 1)..(i + 1) * (segments + 1)].to_vec();
            let centre = Vertex { position: path[i], normal, texture: ring[0].texture };
            ring.into_iter().map(move |v| Vertex { normal, ..v }).chain(vec![centre; segments + 1])
        });
        self.grid(tag, segments + 1, rings);
        for end in ends {
            self.grid(tag, segments + 1, end);
        }
    }

    /// An ellipsoid; the columns of `axes` are its half axes, orthogonal to each other.
    pub(super) fn ellipsoid(&mut self, tag: Tag, centre: Vec3, axes: Mat3, segments: usize) {
        let rows = segments / 2;
        let normals = axes.inverse().transpose();
        let vertices: Vec<_> = (0..=rows)
            .flat_map(|row| (0..=segments).map(move |column| (row, column)))
            .map(|(row, column)| {
                let (s, c) = (PI * row as f32 / rows as f32).sin_cos();
                let (sin, cos) = angle(column, segments).sin_cos();
                let unit = if row == 0 || row == rows {
                    Vec3::Z * c.signum()
                } else {
                    Vec3::new(s * cos, s * sin, c)
                };
                let local = axes * unit;
                Vertex { position: centre + local, normal: (normals * unit).normalize(), texture: local }
            })
            .collect();
        self.grid(tag, segments + 1, vertices);
    }
}

/// Angle of column `i`; the last equals the first exactly, so that the seam is closed.
fn angle(i: usize, segments: usize) -> f32 {
    TAU * (i % segments) as f32 / segments as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Volume enclosed, by the divergence theorem: right only if closed and wound outwards.
    fn volume(mesh: &Mesh) -> f32 {
        (0..mesh.triangles.len())
            .map(|i| {
                let [a, b, c] = mesh.corners(i);
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    const TAG: Tag = Tag { instance: 1, material: Material::Skin };

    #[test]
    fn primitives_are_closed_and_face_outwards() {
        let at = Vec3::new(3.0, -2.0, 5.0);
        let mut cuboid = Mesh::default();
        cuboid.cuboid(TAG, at, at + Vec3::new(1.0, 2.0, 3.0));
        assert!((volume(&cuboid) - 6.0).abs() < 1e-3, "{}", volume(&cuboid));

        let mut cylinder = Mesh::default();
        cylinder.lathe(TAG, at, &[(0.0, 0.0), (1.0, 0.0), (1.0, 2.0), (0.0, 2.0)], 64);
        assert!((volume(&cylinder) - TAU).abs() < 0.02, "{}", volume(&cylinder));

        let mut ball = Mesh::default();
        ball.ellipsoid(TAG, at, Mat3::from_diagonal(Vec3::new(1.0, 2.0, 0.5)), 64);
        assert!((volume(&ball) - 4.0 / 3.0 * PI).abs() < 0.02, "{}", volume(&ball));

        let mut tube = Mesh::default();
        tube.tube(TAG, &[at, at + Vec3::X, at + Vec3::X * 2.0], &[0.5; 3], 64);
        assert!((volume(&tube) - PI / 2.0).abs() < 0.01, "{}", volume(&tube));
    }
}
