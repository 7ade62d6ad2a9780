//! The sum of squared distances to planes, as a function of place.

use std::ops::{Add, AddAssign};

use glam::{DMat3, DVec3, Vec3A};

/// Σ w (n·p + d)² as pᵀ A p + 2 b·p + c.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
}

impl Quadric {
    /// The plane through a point, with a normal whose length is the plane's weight.
    pub(super) fn of_plane(point: Vec3A, normal: Vec3A) -> Self {
        let (n, weight) = (normal.as_dvec3().normalize_or_zero(), f64::from(normal.length()));
        let d = -n.dot(point.as_dvec3());
        let a = DMat3::from_cols(n * n.x, n * n.y, n * n.z);
        Self { a: a * weight, b: n * (d * weight), c: d * d * weight }
    }

    pub(super) fn at(&self, p: Vec3A) -> f64 {
        let p = p.as_dvec3();
        p.dot(self.a * p) + 2.0 * self.b.dot(p) + self.c
    }
}

impl Add for Quadric {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }
}

impl AddAssign for Quadric {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}
