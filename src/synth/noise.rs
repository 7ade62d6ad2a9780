//! Random numbers and band-limited solid noise: everything that makes one seed look unlike another.

use glam::{IVec3, Vec3};

/// SplitMix64 (Steele et al. 2014): small, and the same on every platform.
#[derive(Clone, Debug)]
pub(super) struct Rng(u64);

impl Rng {
    pub(super) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(super) fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in `[low, high)`.
    pub(super) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * ((self.next_u64() >> 40) as f32 / (1u64 << 24) as f32)
    }

    /// Uniform in `0..n`; `n` must not be 0.
    pub(super) fn below(&mut self, n: usize) -> usize {
        (self.next_u64() % n as u64) as usize
    }
}

/// Uniform in [0, 1) from a lattice point (Wellons' `lowbias32` finaliser).
pub(super) fn hash(p: IVec3, salt: u32) -> f32 {
    let mut h = (p.x as u32).wrapping_mul(0x8DA6_B343)
        ^ (p.y as u32).wrapping_mul(0xD816_3841)
        ^ (p.z as u32).wrapping_mul(0xCB1A_B31F)
        ^ salt.wrapping_mul(0x9E37_79B9);
    h = (h ^ (h >> 16)).wrapping_mul(0x7FEB_352D);
    h = (h ^ (h >> 15)).wrapping_mul(0x846C_A68B);
    ((h ^ (h >> 16)) >> 8) as f32 / (1u32 << 24) as f32
}

/// Trilinear value noise on the unit lattice, −1…1.
fn value_noise(p: Vec3, salt: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * (3.0 - 2.0 * f);
    let c = cell.as_ivec3();
    let corner = |x, y, z| hash(c + IVec3::new(x, y, z), salt);
    let along_x = |y, z| corner(0, y, z) + (corner(1, y, z) - corner(0, y, z)) * w.x;
    let along_y = |z| along_x(0, z) + (along_x(1, z) - along_x(0, z)) * w.y;
    2.0 * (along_y(0) + (along_y(1) - along_y(0)) * w.z) - 1.0
}

/// `octaves` of value noise from `size` (m) downwards, about −1…1.
///
/// An octave fades out as its cells approach `footprint`, the width of what one sample stands for: texture
/// that an image cannot show would only be noise that no reconstruction can explain.
pub(super) fn fbm(p: Vec3, size: f32, octaves: u32, footprint: f32, salt: u32) -> f32 {
    let (mut sum, mut amplitude, mut size) = (0.0, 0.5, size);
    for octave in 0..octaves {
        let visible = (1.6 - 2.0 * footprint / size).clamp(0.0, 1.0);
        if visible == 0.0 {
            break;
        }
        sum += amplitude * visible * value_noise(p / size, salt.wrapping_add(octave));
        amplitude *= 0.6;
        size *= 0.5;
    }
    sum
}

/// Share of `[x − footprint/2, x + footprint/2]` that lies on lines of `width` at the multiples of
/// `period`.
pub(super) fn lines(x: f32, period: f32, width: f32, footprint: f32) -> f32 {
    let footprint = footprint.max(1e-4);
    let integral = |x: f32| {
        let n = (x / period).floor();
        n * width + (x - n * period).min(width)
    };
    ((integral(x + footprint / 2.0) - integral(x - footprint / 2.0)) / footprint).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_cover_their_share() {
        let n = 10_000;
        let mean = (0..n).map(|i| lines(i as f32 * 0.001, 0.2, 0.02, 0.05)).sum::<f32>() / n as f32;
        assert!((mean - 0.1).abs() < 1e-3, "{mean}");
        assert!((lines(0.1, 0.2, 0.02, 100.0) - 0.1).abs() < 1e-3);
    }

    #[test]
    fn noise_below_the_footprint_vanishes() {
        let p = Vec3::new(0.3, 0.7, 0.1);
        assert_ne!(fbm(p, 0.1, 3, 0.01, 0), 0.0);
        assert_eq!(fbm(p, 0.1, 3, 0.2, 0), 0.0);
    }
}
