//! The training curve as inline SVG, in the page's own colours.

use std::fmt::Write;

use crate::train::Progress;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 240.0;
const LEFT: f64 = 48.0;
const BOTTOM: f64 = 36.0;
const TOP: f64 = 12.0;
const RIGHT: f64 = 16.0;

/// PSNR of training rays and held-out frames over seconds of training; `None` where there is nothing to draw.
pub fn training_curve(log: &[Progress]) -> Option<String> {
    let train: Vec<[f64; 2]> = points(log.iter().map(|l| (l.seconds, Some(l.psnr))));
    let mut seen = None;
    // The held-out value is repeated in every line until the next look; only its changes are points.
    let test = points(log.iter().map(|l| {
        let new = l.test_psnr != seen;
        seen = l.test_psnr;
        (l.seconds, l.test_psnr.filter(|_| new))
    }));
    let axes = Axes::fit(train.iter().chain(&test))?;
    let mut svg =
        format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"PSNR over training time\">");
    axes.grid(&mut svg);
    line(&mut svg, "train", &axes, &train);
    line(&mut svg, "test", &axes, &test);
    for p in &test {
        let [x, y] = axes.place(*p);
        // Writing to a String cannot fail.
        let _ = write!(
            svg,
            "<circle class=\"test\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\"><title>{:.2} dB at {:.0} s</title></circle>",
            p[1], p[0]
        );
    }
    svg.push_str("</svg>");
    Some(svg)
}

fn points(values: impl Iterator<Item = (f64, Option<f64>)>) -> Vec<[f64; 2]> {
    values.filter_map(|(x, y)| y.filter(|y| y.is_finite() && x.is_finite()).map(|y| [x, y])).collect()
}

/// Ranges of seconds and dB, and where they are in the picture.
struct Axes {
    x: [f64; 2],
    y: [f64; 2],
    step_x: f64,
    step_y: f64,
}

impl Axes {
    fn fit<'a>(points: impl Iterator<Item = &'a [f64; 2]>) -> Option<Self> {
        let mut range: Option<([f64; 2], [f64; 2])> = None;
        for p in points {
            let (low, high) = range.get_or_insert((*p, *p));
            *low = [low[0].min(p[0]), low[1].min(p[1])];
            *high = [high[0].max(p[0]), high[1].max(p[1])];
        }
        let (low, high) = range?;
        let step_y = round_step((high[1] - low[1]).max(1.0) / 4.0);
        let y = [(low[1] / step_y).floor() * step_y, (high[1] / step_y).ceil() * step_y];
        Some(Self {
            x: [0.0, high[0].max(1e-3)],
            y: if y[0] < y[1] { y } else { [y[0], y[0] + step_y] },
            step_x: round_step(high[0].max(1e-3) / 6.0),
            step_y,
        })
    }

    fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let share = |v: f64, [low, high]: [f64; 2]| (v - low) / (high - low);
        [
            LEFT + share(x, self.x) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - share(y, self.y) * (HEIGHT - BOTTOM - TOP),
        ]
    }

    fn grid(&self, svg: &mut String) {
        let (left, right, bottom) = (LEFT, WIDTH - RIGHT, HEIGHT - BOTTOM);
        for y in ticks(self.y, self.step_y) {
            let at = self.place([0.0, y])[1];
            let _ = write!(
                svg,
                "<path class=\"grid\" d=\"M{left} {at:.1}H{right}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{y}</text>",
                left - 6.0,
                at + 4.0
            );
        }
        for x in ticks(self.x, self.step_x) {
            let at = self.place([x, self.y[0]])[0];
            let _ = write!(
                svg,
                "<path class=\"grid\" d=\"M{at:.1} {bottom}v4\"/>\
                 <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{x}</text>",
                bottom + 17.0
            );
        }
        let _ = write!(
            svg,
            "<text x=\"{right}\" y=\"{:.1}\" text-anchor=\"end\">seconds of training</text>\
             <text x=\"2\" y=\"{:.1}\">dB</text>",
            HEIGHT - 4.0,
            TOP + 2.0
        );
    }
}

fn ticks([low, high]: [f64; 2], step: f64) -> impl Iterator<Item = f64> {
    let count = ((high - low) / step + 1e-9) as usize;
    // Rounded, so that 0.30000000000000004 is written as 0.3.
    (0..=count).map(move |n| ((low + n as f64 * step) * 1e6).round() / 1e6)
}

/// The next of 1, 2, 5, 10, … that is not smaller.
fn round_step(least: f64) -> f64 {
    let power = 10f64.powf(least.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|f| f * power >= least * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

fn line(svg: &mut String, class: &str, axes: &Axes, points: &[[f64; 2]]) {
    let _ = write!(svg, "<polyline class=\"{class}\" points=\"");
    for p in points {
        let [x, y] = axes.place(*p);
        let _ = write!(svg, "{x:.1},{y:.1} ");
    }
    svg.push_str("\"/>");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log() -> Vec<Progress> {
        (1..=10)
            .map(|n| Progress {
                step: 50 * n,
                fraction: n as f64 / 10.0,
                seconds: 2.0 * n as f64,
                loss: 0.1,
                psnr: if n == 3 { f64::NAN } else { 15.0 + n as f64 },
                test_psnr: (n >= 5).then_some(if n < 10 { 18.5 } else { 19.5 }),
                rays_per_second: 1.0,
                samples_per_second: 1.0,
            })
            .collect()
    }

    #[test]
    fn every_finite_value_is_a_point_inside_the_picture() {
        let svg = training_curve(&log()).unwrap();
        assert_eq!(svg.matches("<circle").count(), 2, "the held-out frames were looked at twice");
        assert!(!svg.contains("NaN"));
        let (_, rest) = svg.split_once("class=\"train\" points=\"").unwrap();
        let points: Vec<&str> = rest.split('"').next().unwrap().split_whitespace().collect();
        assert_eq!(points.len(), 9);
        for p in points {
            let (x, y) = p.split_once(',').unwrap();
            let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
            assert!((LEFT..=WIDTH).contains(&x) && (TOP - 0.1..=HEIGHT).contains(&y), "{p}");
        }
        assert_eq!(training_curve(&[]), None);
        assert!(training_curve(&log()[..1]).is_some(), "one point has no range");
    }

    #[test]
    fn steps_are_round() {
        for (least, step) in [(0.9, 1.0), (1.0, 1.0), (1.1, 2.0), (3.0, 5.0), (60.0, 100.0), (0.03, 0.05)] {
            assert!((round_step(least) - step).abs() < 1e-9, "{least}: {}", round_step(least));
        }
    }
}
