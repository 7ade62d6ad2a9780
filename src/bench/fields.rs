//! Fields with which marching is timed: one smooth, one of thin structures.

use rayon::prelude::*;

use crate::rng::Rng;

/// Fields on a grid of a unit cube; 0 is the surface and positive is inside.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// Forty gaussians minus a level.
    Smooth,
    /// The shell round a gyroid of three periods.
    Thin,
}

impl Field {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Smooth, Self::Thin];

    /// `smooth` or `thin`.
    pub fn name(self) -> &'static str {
        ["smooth", "thin"][self as usize]
    }

    /// Values at the corners of `dims`, x fastest.
    pub fn sample(self, dims: [usize; 3]) -> Vec<f32> {
        let mut values = vec![0.0; dims.iter().product()];
        let layers = values.par_chunks_mut((dims[0] * dims[1]).max(1)).enumerate();
        match self {
            Self::Smooth => {
                let balls: Vec<Ball> = (0..40).map(|n| Ball::new(n, dims)).collect();
                layers.for_each(|(z, layer)| smooth(&balls, z, dims[0], layer));
            }
            Self::Thin => {
                let waves = axes(dims, |_, t| (3.0 * std::f32::consts::TAU * t).sin_cos());
                layers.for_each(|(z, layer)| thin(&waves, z, layer));
            }
        }
        values
    }
}

/// `f(axis, t)` at the corners along each axis, t from 0 to 1.
fn axes<T>(dims: [usize; 3], f: impl Fn(usize, f32) -> T) -> [Vec<T>; 3] {
    std::array::from_fn(|a| {
        let last = dims[a].saturating_sub(1).max(1) as f32;
        (0..dims[a]).map(|i| f(a, i as f32 / last)).collect()
    })
}

/// A gaussian: the product of one along each axis.
struct Ball([Vec<f32>; 3]);

impl Ball {
    fn new(n: u64, dims: [usize; 3]) -> Self {
        let mut rng = Rng::new(0, 0, n);
        let center: [f32; 3] = std::array::from_fn(|_| 0.15 + 0.7 * rng.uniform());
        let (width, height) = (0.03 + 0.05 * rng.uniform(), 0.5 + rng.uniform());
        Self(axes(dims, |a, t| {
            let bell = (-(t - center[a]).powi(2) / (2.0 * width * width)).exp();
            if a == 2 { height * bell } else { bell }
        }))
    }
}

fn smooth(balls: &[Ball], z: usize, width: usize, layer: &mut [f32]) {
    layer.fill(-0.3);
    for Ball([along_x, along_y, along_z]) in balls {
        for (row, y) in layer.chunks_exact_mut(width).zip(along_y) {
            let weight = y * along_z[z];
            // What is left of a ball this far away does not show in a float.
            if weight > 1e-9 {
                row.iter_mut().zip(along_x).for_each(|(v, x)| *v += weight * x);
            }
        }
    }
}

fn thin([xs, ys, zs]: &[Vec<(f32, f32)>; 3], z: usize, layer: &mut [f32]) {
    let (sin_z, cos_z) = zs[z];
    for (row, (sin_y, cos_y)) in layer.chunks_exact_mut(xs.len()).zip(ys) {
        for (v, (sin_x, cos_x)) in row.iter_mut().zip(xs) {
            *v = 0.25 - (sin_x * cos_y + sin_y * cos_z + sin_z * cos_x).abs();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract::march_dense;

    #[test]
    fn both_fields_have_surfaces() {
        for field in Field::ALL {
            let dims = [40, 33, 36];
            let mesh = march_dense(&field.sample(dims), dims, 0.0).unwrap();
            assert!(mesh.triangles.len() > 3000, "{}: {}", field.name(), mesh.triangles.len());
        }
    }
}
