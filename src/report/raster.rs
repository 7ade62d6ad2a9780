//! A small software rasteriser: meshes and point clouds to pictures, without a graphics card.
//!
//! Triangles are drawn from their front only, so that a room can be looked into from outside. The light comes from the
//! camera.

use divff_exporters::Geometry;
use glam::{DVec3, Mat3, Vec2, Vec3};

/// Nothing nearer than this share of the focal distance is drawn.
const NEAR_SHARE: f32 = 0.01;
/// Side of the block of sub-pixels that becomes a pixel.
const SUPERSAMPLING: usize = 2;
/// Share of the light that comes from everywhere.
const AMBIENT: f32 = 0.42;
/// Colour of a mesh that has none, sRGB.
const PLAIN: [u8; 3] = [190, 190, 190];

/// Where a picture is taken from: a pinhole camera in world coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    /// Camera centre, world units.
    pub eye: DVec3,
    /// Camera-to-world rotation, OpenCV axes (x right, y down, z forward).
    pub rotation: Mat3,
    /// Focal length as a share of the picture's height.
    pub focal: f32,
    /// Distance of what is looked at, world units: the scale for what is too near to draw.
    pub distance: f32,
}

impl Viewpoint {
    /// From `eye` towards `target`, with `up` upwards in the picture.
    ///
    /// `up` must not be parallel to the direction of view; a focal length of 1.4 is a vertical field of view of 39°.
    pub fn looking_at(eye: DVec3, target: DVec3, up: Vec3, focal: f32) -> Self {
        let forward = (target - eye).as_vec3().normalize_or(Vec3::Z);
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let rotation = Mat3::from_cols(right, forward.cross(right), forward);
        Self { eye, rotation, focal, distance: (target - eye).length() as f32 }
    }

    /// From where all of a sphere fits into a picture at least as wide as high, in the direction `from` seen from its
    /// centre.
    pub fn around(centre: DVec3, radius: f64, from: DVec3, up: Vec3) -> Self {
        let focal = 1.4f32;
        // Half the picture is 0.5 high at distance `focal`; a margin of 2 % keeps the sphere off the edges.
        let half_angle = (0.48 / f64::from(focal)).atan();
        let eye = centre + from.normalize_or(DVec3::Z) * radius / half_angle.sin();
        Self::looking_at(eye, centre, up, focal)
    }
}

/// A picture with straight alpha; transparent where nothing was hit. sRGB, row-major.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Picture {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `[height * width]`.
    pub rgba: Vec<[u8; 4]>,
}

/// Draws geometries as seen from a viewpoint; point clouds become single pixels.
pub fn rasterise(geometries: &[&Geometry], view: &Viewpoint, width: usize, height: usize) -> Picture {
    let mut canvas = Canvas::new(view, width * SUPERSAMPLING, height * SUPERSAMPLING);
    for geometry in geometries {
        canvas.draw(geometry);
    }
    canvas.resolve()
}

/// A vertex in camera coordinates.
#[derive(Clone, Copy)]
struct Vertex {
    at: Vec3,
    color: Vec3,
}

struct Canvas<'a> {
    view: &'a Viewpoint,
    width: usize,
    height: usize,
    focal: f32,
    near: f32,
    /// 1/z of the nearest surface, 0 for none.
    inverse_depth: Vec<f32>,
    color: Vec<[u8; 3]>,
}

impl<'a> Canvas<'a> {
    fn new(view: &'a Viewpoint, width: usize, height: usize) -> Self {
        Self {
            view,
            width,
            height,
            focal: view.focal * height as f32,
            near: view.distance * NEAR_SHARE,
            inverse_depth: vec![0.0; width * height],
            color: vec![[0; 3]; width * height],
        }
    }

    fn draw(&mut self, geometry: &Geometry) {
        let vertices: Vec<Vertex> =
            (0..geometry.positions.len()).map(|n| self.to_camera(geometry, n)).collect();
        if geometry.triangles.is_empty() {
            vertices.iter().for_each(|v| self.point(v));
        }
        for triangle in &geometry.triangles {
            // Indices out of range would be a broken file; such a triangle is not drawn.
            let [Some(a), Some(b), Some(c)] = triangle.map(|n| vertices.get(n as usize)) else { continue };
            let corners = [*a, *b, *c];
            let normal = (b.at - a.at).cross(c.at - a.at);
            // Counter-clockwise from outside: the normal of a front points towards the eye at the origin.
            let facing = -normal.dot(a.at);
            if facing <= 0.0 {
                continue;
            }
            let cosine = facing / (normal.length() * a.at.length()).max(1e-30);
            self.clipped(&corners, AMBIENT + (1.0 - AMBIENT) * cosine.min(1.0));
        }
    }

    fn to_camera(&self, geometry: &Geometry, n: usize) -> Vertex {
        let [x, y, z] = geometry.positions[n].map(f64::from);
        let world = DVec3::new(x, y, z) + DVec3::from_array(geometry.offset);
        let color = geometry.colors.get(n).copied().unwrap_or(PLAIN);
        Vertex {
            at: self.view.rotation.transpose() * (world - self.view.eye).as_vec3(),
            color: Vec3::from_array(color.map(f32::from)),
        }
    }

    fn point(&mut self, v: &Vertex) {
        let at = self.project(v.at);
        if v.at.z > self.near
            && at.x >= 0.0
            && at.y >= 0.0
            && at.x < self.width as f32
            && at.y < self.height as f32
        {
            self.put(at.x as usize, at.y as usize, 1.0 / v.at.z, v.color);
        }
    }

    /// Cuts off what is nearer than `near` and draws the rest.
    fn clipped(&mut self, corners: &[Vertex; 3], light: f32) {
        let near = self.near;
        let mut polygon: Vec<Vertex> = Vec::with_capacity(4);
        for n in 0..3 {
            let (a, b) = (corners[n], corners[(n + 1) % 3]);
            if a.at.z > near {
                polygon.push(a);
            }
            if (a.at.z > near) != (b.at.z > near) {
                let t = (near - a.at.z) / (b.at.z - a.at.z);
                polygon.push(Vertex { at: a.at.lerp(b.at, t), color: a.color.lerp(b.color, t) });
            }
        }
        for n in 2..polygon.len() {
            self.triangle([polygon[0], polygon[n - 1], polygon[n]], light);
        }
    }

    fn triangle(&mut self, v: [Vertex; 3], light: f32) {
        let p = v.map(|v| self.project(v.at));
        let area = (p[1] - p[0]).perp_dot(p[2] - p[0]);
        if area.abs() < 1e-12 || !area.is_finite() {
            return;
        }
        let low = p[0].min(p[1]).min(p[2]).max(Vec2::ZERO);
        let high = p[0].max(p[1]).max(p[2]).min(Vec2::new(self.width as f32, self.height as f32));
        // Linear in the picture are 1/z and colour/z, not the colour itself.
        let inverse = v.map(|v| 1.0 / v.at.z);
        for y in low.y as usize..high.y.ceil() as usize {
            for x in low.x as usize..high.x.ceil() as usize {
                let q = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let w = [
                    (p[2] - p[1]).perp_dot(q - p[1]) / area,
                    (p[0] - p[2]).perp_dot(q - p[2]) / area,
                    (p[1] - p[0]).perp_dot(q - p[0]) / area,
                ];
                if w.iter().any(|w| *w < 0.0) {
                    continue;
                }
                let depth = w[0] * inverse[0] + w[1] * inverse[1] + w[2] * inverse[2];
                let color: Vec3 = (0..3).map(|n| v[n].color * (w[n] * inverse[n])).sum::<Vec3>() / depth;
                self.put(x, y, depth, color * light);
            }
        }
    }

    fn project(&self, p: Vec3) -> Vec2 {
        let centre = Vec2::new(self.width as f32, self.height as f32) * 0.5;
        p.truncate() / p.z * self.focal + centre
    }

    fn put(&mut self, x: usize, y: usize, inverse_depth: f32, color: Vec3) {
        let n = y * self.width + x;
        if inverse_depth > self.inverse_depth[n] {
            self.inverse_depth[n] = inverse_depth;
            self.color[n] = color.to_array().map(|c| c.clamp(0.0, 255.0) as u8);
        }
    }

    fn resolve(&self) -> Picture {
        let (width, height) = (self.width / SUPERSAMPLING, self.height / SUPERSAMPLING);
        let pixel = |n: usize| {
            let (x, y) = (n % width * SUPERSAMPLING, n / width * SUPERSAMPLING);
            let (mut sum, mut hits) = ([0u32; 3], 0u32);
            for k in 0..SUPERSAMPLING * SUPERSAMPLING {
                let m = (y + k / SUPERSAMPLING) * self.width + x + k % SUPERSAMPLING;
                if self.inverse_depth[m] > 0.0 {
                    hits += 1;
                    for (sum, c) in sum.iter_mut().zip(self.color[m]) {
                        *sum += u32::from(c);
                    }
                }
            }
            let [r, g, b] = sum.map(|s| (s / hits.max(1)) as u8);
            [r, g, b, (hits * 255 / (SUPERSAMPLING * SUPERSAMPLING) as u32) as u8]
        };
        Picture { width, height, rgba: (0..width * height).map(pixel).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of side 2 in the plane z = `z`, facing -z, i.e. a camera at the origin that looks along z.
    fn square(z: f32, color: [u8; 3]) -> Geometry {
        Geometry {
            positions: vec![[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]],
            colors: vec![color; 4],
            triangles: vec![[0, 2, 1], [0, 3, 2]],
            ..Geometry::default()
        }
    }

    fn ahead() -> Viewpoint {
        Viewpoint { eye: DVec3::ZERO, rotation: Mat3::IDENTITY, focal: 1.0, distance: 4.0 }
    }

    #[test]
    fn a_square_covers_the_pixels_it_projects_to() {
        // At distance 4, focal length 1: half a side is a quarter of the height.
        let picture = rasterise(&[&square(4.0, [200, 100, 50])], &ahead(), 16, 16);
        let hit = |x: usize, y: usize| picture.rgba[y * 16 + x][3];
        for (x, y, alpha) in [(8, 8, 255), (4, 4, 255), (11, 11, 255), (3, 8, 0), (12, 8, 0), (8, 3, 0)] {
            assert_eq!(hit(x, y), alpha, "pixel {x}, {y}");
        }
        let [r, g, b, _] = picture.rgba[8 * 16 + 8];
        assert!(r > 190 && g > 95 && b > 45 && r <= 200, "lit from the front: {r} {g} {b}");
    }

    #[test]
    fn the_nearer_surface_wins_in_any_order() {
        let (near, far) = (square(2.0, [255, 0, 0]), square(4.0, [0, 255, 0]));
        let one = rasterise(&[&near, &far], &ahead(), 16, 16);
        assert_eq!(one, rasterise(&[&far, &near], &ahead(), 16, 16));
        assert!(one.rgba[8 * 16 + 8][0] > 200);
    }

    #[test]
    fn backs_and_what_is_behind_the_camera_are_not_drawn() {
        let empty = |g: &Geometry| rasterise(&[g], &ahead(), 8, 8).rgba.iter().all(|p| p[3] == 0);
        let mut back = square(4.0, [9; 3]);
        for t in &mut back.triangles {
            t.swap(1, 2);
        }
        assert!(empty(&back));
        assert!(empty(&square(-4.0, [9; 3])));
        assert!(empty(&Geometry { triangles: vec![[0, 1, 9]], ..square(4.0, [9; 3]) }));
    }

    /// A floor that begins behind the camera: the part in front must not be lost.
    #[test]
    fn triangles_through_the_camera_plane_are_cut_not_dropped() {
        let floor = Geometry {
            positions: vec![[-50.0, 1.0, -50.0], [50.0, 1.0, -50.0], [0.0, 1.0, 80.0]],
            triangles: vec![[0, 1, 2]],
            ..Geometry::default()
        };
        let mirrored = Geometry { triangles: vec![[0, 2, 1]], ..floor.clone() };
        let covered = |g| rasterise(&[g], &ahead(), 16, 16).rgba.iter().filter(|p| p[3] == 255).count();
        assert!(covered(&floor) + covered(&mirrored) > 60);
    }

    #[test]
    fn a_sphere_fits_into_the_picture_that_is_taken_around_it() {
        let view = Viewpoint::around(DVec3::new(5.0, 0.0, 0.0), 2.0, DVec3::new(1.0, 1.0, 1.0), Vec3::Z);
        let points = Geometry {
            positions: (0..200)
                .map(|n| {
                    let (z, angle) = (n as f32 / 99.5 - 1.0, n as f32 * 2.4);
                    let r = (1.0 - z * z).max(0.0).sqrt();
                    [5.0 + 2.0 * r * angle.cos(), 2.0 * r * angle.sin(), 2.0 * z]
                })
                .collect(),
            ..Geometry::default()
        };
        let picture = rasterise(&[&points], &view, 100, 100);
        let border = |n: usize| n.is_multiple_of(100) || n % 100 == 99 || !(100..9900).contains(&n);
        let drawn: Vec<usize> = (0..10_000).filter(|n| picture.rgba[*n][3] > 0).collect();
        assert!(drawn.len() > 150 && !drawn.iter().any(|n| border(*n)));
        let rows =
            drawn.iter().map(|n| n / 100).max().unwrap() - drawn.iter().map(|n| n / 100).min().unwrap();
        assert!(rows > 90, "it fills the picture");
    }
}
