//! Planes as a camera sees them: inverse depth is affine in the pixel.

use glam::{DMat3, DVec3};

use crate::rng::Rng;

/// How far a thing's surface may be from the plane through it, as a share of its depth.
const PLANE_ERROR: f64 = 0.08;

/// Times a plane is fitted, each time to what is nearer to the one before.
const FITS: u32 = 3;

/// Points without which there is no plane.
const LEAST_POINTS: usize = 8;

/// Planes through three random points that are tried ([`Plane::agreed`]).
const TRIES: usize = 48;

/// How far a point of a plane may be from it, as a share of its inverse depth.
const AGREES: f64 = 0.02;

/// Neighbouring points have errors in common: this many count as one.
const ALIKE: f64 = 16.0;

/// A pixel's direction with z = 1, and its inverse depth.
pub type Point = (DVec3, f64);

/// Inverse depths that are affine in the pixel.
pub struct Plane {
    coefficients: DVec3,
    /// Inverse depths of the points that it was fitted to.
    range: [f64; 2],
    /// Covariance of the coefficients.
    covariance: DMat3,
}

impl Plane {
    /// A least-squares fit that leaves out what does not fit it; `None` with too few points, or all on a line.
    pub fn through(points: &[Point]) -> Option<Self> {
        // A mask's edge shows what is behind it: the median is not moved by that.
        let mut inverse: Vec<f64> = points.iter().map(|p| p.1).collect();
        inverse.sort_by(f64::total_cmp);
        let median = *inverse.get(inverse.len() / 2)?;
        let flat =
            Self { coefficients: DVec3::Z * median, range: [0.0, f64::INFINITY], covariance: DMat3::ZERO };
        (0..FITS).try_fold(flat, |plane, round| {
            let bound = PLANE_ERROR * f64::from(FITS - round);
            let fitting: Vec<_> =
                points.iter().filter(|(p, i)| (plane.at(*p) / i - 1.0).abs() < bound).copied().collect();
            Self::fit(&fitting)
        })
    }

    /// The plane that most points agree on, found by trying planes through three of them (Fischler and Bolles 1981), and
    /// the share that does; `None` as for [`Self::through`].
    pub fn agreed(points: &[Point], rng: &mut Rng) -> Option<(Self, f64)> {
        let mut best = (0, DVec3::ZERO);
        for _ in 0..TRIES {
            let three = [0; 3].map(|_| points[rng.below(points.len())]);
            let matrix = DMat3::from_cols(three[0].0, three[1].0, three[2].0).transpose();
            if matrix.determinant().abs() < 1e-9 {
                continue;
            }
            let tried = matrix.inverse() * DVec3::from_array(three.map(|p| p.1));
            let agree = points.iter().filter(|p| agrees(tried, p)).count();
            if agree > best.0 {
                best = (agree, tried);
            }
        }
        let agreeing: Vec<Point> = points.iter().filter(|p| agrees(best.1, p)).copied().collect();
        let plane = Self::fit(&agreeing)?;
        Some((plane, agreeing.len() as f64 / points.len() as f64))
    }

    fn fit(points: &[Point]) -> Option<Self> {
        if points.len() < LEAST_POINTS {
            return None;
        }
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        let mut range = [f64::INFINITY, 0.0f64];
        for (p, inverse) in points {
            matrix += DMat3::from_cols(*p * p.x, *p * p.y, *p * p.z);
            right += *p * *inverse;
            range = [range[0].min(*inverse), range[1].max(*inverse)];
        }
        if matrix.determinant().abs() <= 1e-12 * (points.len() as f64).powi(3) {
            return None;
        }
        let inverted = matrix.inverse();
        let coefficients = inverted * right;
        let squares: f64 = points.iter().map(|(p, inverse)| (coefficients.dot(*p) - inverse).powi(2)).sum();
        Some(Self { coefficients, range, covariance: inverted * (ALIKE * squares / points.len() as f64) })
    }

    /// Inverse depth at a pixel; no farther and no nearer than what is known.
    pub fn at(&self, p: DVec3) -> f64 {
        self.coefficients.dot(p).clamp(self.range[0], self.range[1])
    }

    /// Inverse depth at a pixel, if the points tell it to the share `error`.
    pub fn known_at(&self, p: DVec3, error: f64) -> Option<f64> {
        let inverse = self.coefficients.dot(p);
        let deviation = p.dot(self.covariance * p).max(0.0).sqrt();
        (inverse > 0.0 && deviation < error * inverse).then_some(inverse)
    }

    /// Whether an inverse depth is the surface's where the plane has `expected`.
    pub fn fits(&self, expected: f64, found: f64) -> bool {
        (found / expected - 1.0).abs() < PLANE_ERROR
    }
}

fn agrees(coefficients: DVec3, (p, inverse): &Point) -> bool {
    (coefficients.dot(*p) / inverse - 1.0).abs() < AGREES
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64) -> DVec3 {
        DVec3::new(x, y, 1.0)
    }

    fn inverse(p: DVec3) -> f64 {
        0.5 + 0.2 * p.x - 0.1 * p.y
    }

    /// `columns` × `rows` points of the plane.
    fn points(columns: usize, rows: usize) -> Vec<Point> {
        (0..columns * rows)
            .map(|n| at(0.1 * (n % columns) as f64, 0.1 * (n / columns) as f64))
            .map(|p| (p, inverse(p)))
            .collect()
    }

    #[test]
    fn a_plane_is_found_and_stays_within_what_is_known() {
        let points = points(4, 3);
        let plane = Plane::through(&points).expect("twelve points span a plane");
        assert!((plane.at(at(0.15, 0.05)) - inverse(at(0.15, 0.05))).abs() < 1e-12);
        assert!((plane.at(at(9.0, 0.0)) - 0.56).abs() < 1e-12, "no farther than the farthest that is known");
        let mut behind = points.clone();
        behind.extend([(at(0.0, 0.4), 0.2), (at(0.1, 0.4), 0.2), (at(0.3, 0.4), 0.1)]);
        let robust = Plane::through(&behind).expect("most points are on a plane");
        assert!((robust.at(at(0.15, 0.05)) - inverse(at(0.15, 0.05))).abs() < 1e-9);
        assert!(Plane::through(&points[..7]).is_none());
        assert!(Plane::through(&vec![(at(0.1, 0.1), 0.5); 20]).is_none());
    }

    #[test]
    fn most_points_agree_on_a_steep_plane_whatever_the_others_say() {
        let mut points = points(6, 5);
        let planar = points.len();
        points.extend((0..10).map(|n| (at(0.05 * f64::from(n), 0.3), 0.9 + 0.03 * f64::from(n))));
        let (plane, share) = Plane::agreed(&points, &mut Rng::new(1, 2, 3)).expect("there is a plane");
        assert!((share - planar as f64 / points.len() as f64).abs() < 1e-12, "{share}");
        let far = at(1.5, -0.8);
        assert!((plane.known_at(far, 0.01).expect("the points are exact") - inverse(far)).abs() < 1e-9);
        assert!(Plane::agreed(&vec![(at(0.1, 0.1), 0.5); 20], &mut Rng::new(1, 2, 3)).is_none());
    }

    #[test]
    fn what_noisy_points_say_of_far_away_pixels_is_not_known() {
        let mut rng = Rng::new(4, 5, 6);
        let noisy: Vec<Point> = points(5, 5)
            .into_iter()
            .map(|(p, i)| (p, i * (1.0 + 0.01 * (f64::from(rng.uniform()) - 0.5))))
            .collect();
        let (plane, _) = Plane::agreed(&noisy, &mut rng).expect("there is a plane");
        assert!(plane.known_at(at(0.25, 0.25), 0.02).is_some());
        assert!(plane.known_at(at(9.0, -9.0), 0.02).is_none());
    }
}
