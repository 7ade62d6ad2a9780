//! Which settings are worth choosing from, and which one to choose when nothing else is known.

/// Cost and error of a setting; less is better in both.
pub type Point = [f64; 2];

/// The points that no other one dominates, by rising cost.
///
/// A point dominates another if it is no worse in both and better in one. Points with NaN are left out.
pub fn front(points: &[Point]) -> Vec<usize> {
    let known = |n: &usize| points[*n].iter().all(|v| !v.is_nan());
    let dominates = |a: Point, b: Point| a[0] <= b[0] && a[1] <= b[1] && a != b;
    let mut found: Vec<usize> = (0..points.len())
        .filter(known)
        .filter(|&n| !(0..points.len()).any(|m| dominates(points[m], points[n])))
        .collect();
    found.sort_by(|&a, &b| points[a][0].total_cmp(&points[b][0]));
    found
}

/// The point of the front that is nearest to the best of both, with each range of the front taken as one.
///
/// Costs differ by factors, so they are compared by their logarithms where all are positive.
pub fn recommended(points: &[Point]) -> Option<usize> {
    let front = front(points);
    let positive = front.iter().all(|&n| points[n][0] > 0.0);
    let scaled = |n: usize| [if positive { points[n][0].ln() } else { points[n][0] }, points[n][1]];
    let share = |n: usize, axis: usize| {
        let all = || front.iter().map(|&m| scaled(m)[axis]);
        let (low, high) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
        if high > low { (scaled(n)[axis] - low) / (high - low) } else { 0.0 }
    };
    let distance = |n: &usize| share(*n, 0).hypot(share(*n, 1));
    front.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_is_what_no_other_point_dominates() {
        let points =
            [[1.0, 9.0], [2.0, 5.0], [2.0, 6.0], [3.0, 5.0], [4.0, 1.0], [5.0, 1.0], [0.5, 9.5], [6.0, 0.5]];
        assert_eq!(front(&points), [6, 0, 1, 4, 7]);
        assert_eq!(front(&[[1.0, 1.0], [1.0, 1.0]]), [0, 1], "equal points do not dominate each other");
        assert_eq!(front(&[[f64::NAN, 0.0], [1.0, f64::NAN], [2.0, 2.0]]), [2]);
        assert!(front(&[]).is_empty());
    }

    #[test]
    fn no_point_of_a_front_dominates_another_and_all_others_are_dominated() {
        // What is cheaper is worse, but for some noise.
        let point = |n: u32| [f64::from(n * 37 % 61), f64::from(61 - n * 37 % 61 + n * 23 % 17)];
        let points: Vec<Point> = (0..60).map(point).collect();
        let found = front(&points);
        let dominated =
            |n: usize| points.iter().any(|p| p[0] <= points[n][0] && p[1] <= points[n][1] && *p != points[n]);
        for n in 0..points.len() {
            assert_eq!(found.contains(&n), !dominated(n), "{:?}", points[n]);
        }
        assert!((5..55).contains(&found.len()), "{found:?}");
    }

    #[test]
    fn the_knee_is_recommended() {
        // Twice the cost for nearly all of the gain, then eight times as much for the rest.
        let points = [[1.0, 10.0], [2.0, 2.0], [16.0, 1.0], [3.0, 4.0]];
        assert_eq!(recommended(&points), Some(1));
        assert_eq!(recommended(&[[3.0, 1.0]]), Some(0));
        assert_eq!(recommended(&[[0.0, 1.0], [5.0, 1.0]]), Some(0), "a cost of nothing has no logarithm");
        assert_eq!(recommended(&[]), None);
    }
}
