//! Point clouds: samples spread evenly over a surface, with the vertices' columns interpolated.

use glam::Vec3A;
use rayon::prelude::*;

use super::{ExtractError, TriMesh};

/// Points on a mesh: for each the triangle and the barycentric weights of its corners (they sum to 1).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfaceSamples {
    /// `[samples]`, relative to the grid's origin, world units.
    pub positions: Vec<[f32; 3]>,
    /// `[samples]`, the three vertices of the triangle.
    pub vertices: Vec<[u32; 3]>,
    /// `[samples]`.
    pub weights: Vec<[f32; 3]>,
}

/// `count` area-uniform samples, in triangle order.
///
/// Stratified: the surface is cut into `count` pieces of equal area and each holds one sample, so the cloud
/// is more even than independent draws. The same `seed` gives the same samples. A mesh without area has none.
pub fn sample_surface(mesh: &TriMesh, count: usize, seed: u64) -> SurfaceSamples {
    let mut total = 0.0;
    let upto: Vec<f64> = (0..mesh.triangles.len())
        .map(|t| {
            total += mesh.area(t);
            total
        })
        .collect();
    if total.is_nan() || total <= 0.0 || count == 0 {
        return SurfaceSamples::default();
    }
    let one = |i: usize| {
        let random = |k: u64| unit_random(seed, 3 * i as u64 + k);
        let target = (i as f64 + random(0)) / count as f64 * total;
        let t = upto.partition_point(|&u| u <= target).min(upto.len() - 1);
        // The square root makes points uniform in the triangle (Osada et al. 2002).
        let (r, s) = (random(1).sqrt(), random(2));
        let weights = [1.0 - r, r * (1.0 - s), r * s].map(|w| w as f32);
        let corners = mesh.corners(t);
        let p: Vec3A = corners.iter().zip(weights).map(|(&p, w)| p * w).sum();
        (p.to_array(), (mesh.triangles[t], weights))
    };
    let (positions, (vertices, weights)) = (0..count).into_par_iter().map(one).unzip();
    SurfaceSamples { positions, vertices, weights }
}

impl SurfaceSamples {
    /// Interpolates a column of the vertices, `[vertices * dim]` to `[samples * dim]`. (Normalise unit
    /// vectors after.)
    ///
    /// # Errors
    /// `Length` where the column has no whole rows or too few of them, `Invalid` for `dim` 0.
    pub fn interpolate(&self, column: &[f32], dim: usize) -> Result<Vec<f32>, ExtractError> {
        ExtractError::require(dim > 0, "column width", dim, "at least 1")?;
        let rows = self.vertices.iter().flatten().max().map_or(0, |&v| v as usize + 1);
        if !column.len().is_multiple_of(dim) || column.len() / dim < rows {
            let what = format!("a vertex column of width {dim}");
            return Err(ExtractError::Length { what, expected: rows * dim, found: column.len() });
        }
        let mut out = vec![0.0; self.positions.len() * dim];
        out.par_chunks_mut(dim).zip(&self.vertices).zip(&self.weights).for_each(
            |((out, vertices), weights)| {
                for (&v, &w) in vertices.iter().zip(weights) {
                    let row = &column[v as usize * dim..(v as usize + 1) * dim];
                    out.iter_mut().zip(row).for_each(|(o, &c)| *o += w * c);
                }
            },
        );
        Ok(out)
    }

    /// Interpolates 8-bit colours of the vertices.
    ///
    /// # Errors
    /// As [`Self::interpolate`].
    pub fn interpolate_colors(&self, colors: &[[u8; 3]]) -> Result<Vec<[u8; 3]>, ExtractError> {
        let column: Vec<f32> = colors.iter().flatten().map(|&c| f32::from(c)).collect();
        let flat = self.interpolate(&column, 3)?;
        Ok(flat.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|v| (v + 0.5) as u8)).collect())
    }

    /// Interpolates unit normals of the vertices and normalises them again; +z where they cancel.
    ///
    /// # Errors
    /// As [`Self::interpolate`].
    pub fn interpolate_normals(&self, normals: &[[f32; 3]]) -> Result<Vec<[f32; 3]>, ExtractError> {
        let flat = self.interpolate(normals.as_flattened(), 3)?;
        let unit = |n: &[f32]| Vec3A::from_slice(n).try_normalize().unwrap_or(Vec3A::Z).to_array();
        Ok(flat.chunks_exact(3).map(unit).collect())
    }
}

/// Number `index` of the sequence of `seed`, in `[0, 1)`: SplitMix64 (Steele et al. 2014), random access.
fn unit_random(seed: u64, index: u64) -> f64 {
    let mix = |mut z: u64| {
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    };
    let z = mix(mix(seed).wrapping_add(index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
    // 53 bits fill an f64's mantissa.
    (z >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::super::march;
    use super::super::testing::grid;
    use super::*;

    /// Two triangles of area 1/2 and 3/2.
    fn pair() -> TriMesh {
        let positions = vec![
            [0.0; 3],
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [5.0, 0.0, 0.0],
            [8.0, 0.0, 0.0],
            [5.0, 1.0, 0.0],
        ];
        TriMesh { positions, triangles: vec![[0, 1, 2], [3, 4, 5]] }
    }

    #[test]
    fn samples_follow_the_area_and_lie_evenly_in_a_triangle() {
        let samples = sample_surface(&pair(), 40_000, 7);
        let first = samples.positions.iter().filter(|p| p[0] < 2.0).count();
        assert!(first.abs_diff(10_000) <= 1, "stratified: {first}");
        // The mean of uniform samples is the centroid; 3 sigma of 10,000 draws is 0.008.
        let mean: f32 =
            samples.positions.iter().filter(|p| p[0] < 2.0).map(|p| p[0]).sum::<f32>() / first as f32;
        assert!((mean - 1.0 / 3.0).abs() < 0.008, "{mean}");
        let corner = samples.positions.iter().filter(|p| p[0] + p[1] < 0.5).count() as f64 / first as f64;
        assert!((corner - 0.25).abs() < 0.015, "a quarter of the area: {corner}");
        assert!(samples.weights.iter().all(|w| (w.iter().sum::<f32>() - 1.0).abs() < 1e-6));
    }

    #[test]
    fn columns_are_linear_on_the_surface() {
        let mesh = march(&grid(24, 1.0, |p| 0.4 - p.distance(Vec3A::splat(0.5))), 0.0).unwrap();
        let samples = sample_surface(&mesh, 2000, 1);
        let positions = samples.interpolate(mesh.positions.as_flattened(), 3).unwrap();
        assert!(positions.iter().zip(samples.positions.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-6));
        let colors = samples.interpolate_colors(&vec![[10, 20, 255]; mesh.positions.len()]).unwrap();
        assert!(colors.iter().all(|&c| c == [10, 20, 255]));
        let normals = samples.interpolate_normals(&vec![[0.0, 0.6, 0.8]; mesh.positions.len()]).unwrap();
        assert!(normals.iter().all(|n| (n[1] - 0.6).abs() < 1e-6));
        assert!(samples.interpolate(&[0.0; 10], 1).is_err());
        assert!(samples.interpolate(&[], 0).is_err());
    }

    #[test]
    fn seed_decides_and_threads_do_not() {
        let run = |threads: usize, seed: u64| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| sample_surface(&pair(), 1000, seed))
        };
        assert_eq!(run(1, 3), run(4, 3));
        assert_ne!(run(1, 3), run(1, 4));
        assert_eq!(sample_surface(&TriMesh::default(), 10, 0), SurfaceSamples::default());
        let line = TriMesh { positions: vec![[1.0; 3]; 3], triangles: vec![[0, 1, 2]] };
        assert!(sample_surface(&line, 10, 0).positions.is_empty());
    }
}
