//! The training curve, and costs against quality, as SVG in the page's own colours.

use std::fmt::Write;

use super::html::escaped;
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
    // A curve that hardly moves is not blown up to the whole height: it has at least one decibel.
    let axes = Axes::fit(train.iter().chain(&test), 1.0)?;
    let mut svg = opening("PSNR over training time");
    axes.grid(&mut svg, ["seconds of training", "dB"]);
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

/// A setting in a plot of costs.
pub struct Mark {
    /// Its name.
    pub label: String,
    /// Cost and quality, finite.
    pub at: [f64; 2],
    /// Whether no other setting is better in both.
    pub on_front: bool,
    /// Whether it is recommended.
    pub best: bool,
}

/// Settings by cost and quality, with a line along their front; `None` where there is nothing to draw.
pub fn scatter(marks: &[Mark], labels: [&str; 2]) -> Option<String> {
    let axes = Axes::fit(marks.iter().map(|m| &m.at), 0.0)?;
    let mut svg = opening(&format!("{} over {}", labels[1], labels[0]));
    axes.grid(&mut svg, labels);
    let mut front: Vec<[f64; 2]> = marks.iter().filter(|m| m.on_front).map(|m| m.at).collect();
    front.sort_by(|a, b| a[0].total_cmp(&b[0]));
    line(&mut svg, "front", &axes, &front);
    for mark in marks {
        let [x, y] = axes.place(mark.at);
        let class = match (mark.best, mark.on_front) {
            (true, _) => "best",
            (false, true) => "front",
            (false, false) => "behind",
        };
        let radius = if mark.best { 6 } else { 4 };
        // Names near the right edge end at their point instead of starting there.
        let (at, anchor) = if x > 0.75 * WIDTH { (x - 8.0, "end") } else { (x + 8.0, "start") };
        let label = escaped(&mark.label);
        let _ = write!(
            svg,
            "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\"><title>{label}: {}, {}</title>\
             </circle><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">{label}</text>",
            mark.at[0],
            mark.at[1],
            y - 6.0
        );
    }
    svg.push_str("</svg>");
    Some(svg)
}

/// An SVG of this module as a file of its own.
pub fn standalone(svg: &str) -> String {
    let style = format!("<style>{COLOURS}</style>");
    let (opening, rest) = svg.split_at(svg.find('>').map_or(0, |at| at + 1));
    format!("{}{style}{rest}\n", opening.replacen("<svg", "<svg xmlns=\"http://www.w3.org/2000/svg\"", 1))
}

/// The rules of the page that a chart needs, without the page.
const COLOURS: &str = "svg{background:#fff}text{fill:#5d6878;font:11px system-ui,sans-serif}\
    .grid{stroke:#dfe3ea;fill:none}polyline{fill:none;stroke:#2f6fdb;stroke-width:1.8}\
    .behind{fill:#aab3c0}.front{fill:#2f6fdb}polyline.front{fill:none}.best{fill:#d9480f}";

fn opening(title: &str) -> String {
    format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">", escaped(title))
}

fn points(values: impl Iterator<Item = (f64, Option<f64>)>) -> Vec<[f64; 2]> {
    values.filter_map(|(x, y)| y.filter(|y| y.is_finite() && x.is_finite()).map(|y| [x, y])).collect()
}

/// Ranges along both axes, and where they are in the picture.
struct Axes {
    x: [f64; 2],
    y: [f64; 2],
    step_x: f64,
    step_y: f64,
}

impl Axes {
    /// Axes that hold all points; upwards at least `least` of it. `None` without points.
    fn fit<'a>(points: impl Iterator<Item = &'a [f64; 2]>, least: f64) -> Option<Self> {
        let mut range: Option<([f64; 2], [f64; 2])> = None;
        for p in points {
            let (low, high) = range.get_or_insert((*p, *p));
            *low = [low[0].min(p[0]), low[1].min(p[1])];
            *high = [high[0].max(p[0]), high[1].max(p[1])];
        }
        let (low, high) = range?;
        // A single value has no range; a tenth of it gives the axis a scale.
        let span = (high[1] - low[1]).max(least).max(0.1 * high[1].abs().min(1.0)).max(1e-6);
        let step_y = round_step(span / 4.0);
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

    fn grid(&self, svg: &mut String, [across, up]: [&str; 2]) {
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
            "<text x=\"{right}\" y=\"{:.1}\" text-anchor=\"end\">{across}</text>\
             <text x=\"2\" y=\"{:.1}\">{up}</text>",
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
    fn settings_are_drawn_inside_and_their_names_are_harmless() {
        let mark = |label: &str, x: f64, y: f64| Mark {
            label: label.into(),
            at: [x, y],
            on_front: y < 0.02,
            best: x == 3.0,
        };
        let marks = [mark("a<b", 1.0, 0.051), mark("c", 3.0, 0.013), mark("d", 90.0, 0.0125)];
        let svg = scatter(&marks, ["seconds", "chamfer_m"]).unwrap();
        assert!(svg.contains("a&lt;b") && !svg.contains("a<b"));
        let places: Vec<f64> =
            svg.split("cy=\"").skip(1).map(|s| s.split('"').next().unwrap().parse().unwrap()).collect();
        assert_eq!(places.len(), 3);
        assert!(places.iter().all(|y| (TOP - 0.1..=HEIGHT - BOTTOM + 0.1).contains(y)), "{places:?}");
        assert!(places[0] < places[1], "more is further up");
        assert!(standalone(&svg).starts_with("<svg xmlns="));
        assert!(scatter(&[], ["x", "y"]).is_none());
    }

    #[test]
    fn steps_are_round() {
        for (least, step) in [(0.9, 1.0), (1.0, 1.0), (1.1, 2.0), (3.0, 5.0), (60.0, 100.0), (0.03, 0.05)] {
            assert!((round_step(least) - step).abs() < 1e-9, "{least}: {}", round_step(least));
        }
    }
}
