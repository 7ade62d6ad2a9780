//! What a run says on standard error: a bar on a terminal, a line now and then elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use divff::map;
use divff::pipeline::{Event, Observer, Stage};
use divff::train::Progress;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::output::tell;
use super::stop::StopFlag;

/// Between two lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Positions of the bar; training counts in fractions of its schedule.
const BAR_LENGTH: u64 = 1000;

/// Follows a run on standard error.
pub struct Reporter {
    stop: StopFlag,
    terminal: bool,
    bar: ProgressBar,
    stage_start: Instant,
    last_line: Option<Instant>,
}

impl Reporter {
    /// A reporter that asks `stop` whether to go on.
    pub fn new(stop: StopFlag) -> Self {
        let now = Instant::now();
        let terminal = std::io::stderr().is_terminal();
        Self { stop, terminal, bar: ProgressBar::hidden(), stage_start: now, last_line: None }
    }

    /// Says something that stays on the screen.
    pub fn note(&self, text: &str) {
        match self.terminal {
            true => self.bar.suspend(|| tell(text)),
            false => tell(text),
        }
    }

    fn start(&mut self, what: &'static str) {
        self.bar.finish_and_clear();
        self.stage_start = Instant::now();
        self.last_line = None;
        if !self.terminal {
            tell(what);
            return;
        }
        self.bar = ProgressBar::with_draw_target(Some(BAR_LENGTH), ProgressDrawTarget::stderr());
        // The template is fixed and known to be good; a plain bar would do as well.
        if let Ok(style) = ProgressStyle::with_template("{prefix:10} {bar:28} {percent:>3} %  {msg}") {
            self.bar.set_style(style);
        }
        self.bar.set_prefix(what);
        self.bar.tick();
    }

    fn advance(&mut self, fraction: f64, text: impl Fn() -> String) {
        if self.terminal {
            self.bar.set_message(text());
            self.bar.set_position((fraction * BAR_LENGTH as f64) as u64);
            return;
        }
        let due = self.last_line.unwrap_or(self.stage_start).elapsed() >= LINE_EVERY;
        if due || fraction >= 1.0 {
            tell(format_args!("  {:3.0} %  {}", 100.0 * fraction, text()));
            self.last_line = Some(Instant::now());
        }
    }

    fn training(&mut self, p: &Progress) {
        let left = p.seconds * (1.0 - p.fraction) / p.fraction.max(1e-9);
        self.advance(p.fraction, || {
            let test = p.test_psnr.map_or(String::new(), |v| format!(", held out {v:.2} dB"));
            format!(
                "step {}, loss {:.3}, PSNR {:.2} dB{test}, {:.0}k rays/s, {} left",
                p.step,
                p.loss,
                p.psnr,
                p.rays_per_second / 1e3,
                human(left)
            )
        });
    }
}

impl Observer for Reporter {
    fn event(&mut self, event: &Event) {
        match event {
            Event::Stage(stage) => self.start(match stage {
                Stage::Training => "training",
                Stage::Features => "features",
                Stage::Mapping => "mapping",
                Stage::Exporting => "exporting",
                Stage::Rendering => "rendering",
                Stage::Evaluating => "evaluating",
                Stage::Reporting => "reporting",
            }),
            Event::Setting { sweep, setting } => self.note(&format!("{sweep}: {setting}")),
            Event::Resuming { step, seconds } => {
                self.note(&format!("going on after step {step} ({} of training)", human(*seconds)));
            }
            Event::AlreadyTrained { step } => {
                self.note(&format!("already trained ({step} steps); --fresh starts over"));
            }
            Event::Training(progress) => self.training(progress),
            Event::Features(p) => {
                self.advance(p.fraction, || format!("{}: step {}, loss {:.4}", p.what, p.step, p.loss));
            }
            Event::Mapping(p) => {
                // Stages differ in length; each counts as one part of the bar.
                let stages = [
                    (map::Stage::Depth, "depth of all frames"),
                    (map::Stage::Persistent, "what stays"),
                    (map::Stage::Dynamic, "what is moved"),
                    (map::Stage::Actor, "who moves it"),
                    (map::Stage::Points, "points"),
                    (map::Stage::Simplify, "simplifying"),
                ];
                let part = stages.iter().position(|(s, _)| *s == p.stage).unwrap_or(0);
                let inside = p.done as f64 / p.total.max(1) as f64;
                let fraction = (part as f64 + inside) / stages.len() as f64;
                self.advance(fraction, || format!("{} ({} of {})", stages[part].1, p.done, p.total));
            }
            Event::Views { done, total } => {
                self.advance(*done as f64 / (*total).max(1) as f64, || format!("frame {done} of {total}"));
            }
            _ => {}
        }
    }

    fn stop(&self) -> bool {
        self.stop.is_set()
    }
}

impl Drop for Reporter {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

/// `47 s`, `3 min 20 s`, `2 h 05 min`.
pub fn human(seconds: f64) -> String {
    let s = seconds.max(0.0).round() as u64;
    match s {
        0..60 => format!("{s} s"),
        60..3600 => format!("{} min {:02} s", s / 60, s % 60),
        _ => format!("{} h {:02} min", s / 3600, s % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::human;

    #[test]
    fn times_are_told_in_two_units() {
        assert_eq!(
            [human(-1.0), human(59.4), human(59.6), human(7500.0)],
            ["0 s", "59 s", "1 min 00 s", "2 h 05 min"]
        );
    }
}
