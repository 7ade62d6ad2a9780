//! The two result tables of the DIV-FF paper, of one scene: how well objects and affordances are found, by whom, and what
//! it took.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Serialize;

use crate::eval::{THRESHOLD, Task};

/// How much better video-language features should find affordances than image-language ones (paper: 20.7 / 11.8).
pub const VIDEO_OVER_IMAGE: f64 = 1.5;

/// One line of a table.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TableRow {
    /// As the paper calls it.
    pub method: String,
    /// Mean over all objects or regions and test frames, and over seeds, 0–1.
    pub miou: Option<f64>,
    /// The mean's standard error, from how much the seeds differ.
    pub miou_error: Option<f64>,
    /// Mean over the test frames of each phrase that covers 50 px in any.
    pub phrases: BTreeMap<String, f64>,
    /// dB of the geometry over all test pixels.
    pub psnr: Option<f64>,
    /// Seconds of training the geometry, which rows may share.
    pub geometry_seconds: Option<f64>,
    /// Seconds of training the fields of features, of both spaces.
    pub feature_seconds: Option<f64>,
    /// Why there is no figure.
    pub absent: Option<String>,
}

impl TableRow {
    /// Repeats of one row, which differ by their seeds.
    ///
    /// # Panics
    /// If there are none.
    pub fn mean(repeats: impl Iterator<Item = Self>) -> Self {
        let repeats: Vec<Self> = repeats.collect();
        let mut row = repeats[0].clone();
        let of =
            |value: &dyn Fn(&Self) -> Option<f64>| repeats.iter().map(value).collect::<Option<Vec<f64>>>();
        let average = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        row.miou_error = of(&|r| r.miou).filter(|v| v.len() > 1).map(|values| {
            let (mean, n) = (average(&values), values.len() as f64);
            (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0) / n).sqrt()
        });
        row.miou = of(&|r| r.miou).map(|v| average(&v));
        row.feature_seconds = of(&|r| r.feature_seconds).map(|v| average(&v));
        for (phrase, value) in &mut row.phrases {
            *value = of(&|r| r.phrases.get(phrase).copied()).map_or(*value, |v| average(&v));
        }
        row
    }
}

/// A row of [`OrderCheck`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OrderedRow {
    /// Short name.
    pub name: String,
    /// mIoU on objects.
    pub miou: Option<f64>,
    /// Its standard error.
    pub error: Option<f64>,
}

impl OrderedRow {
    /// What a row of the tables says, if it is there.
    pub fn new(name: &str, row: Option<&TableRow>) -> Self {
        Self { name: name.into(), miou: row.and_then(|r| r.miou), error: row.and_then(|r| r.miou_error) }
    }
}

/// What one claim of the paper comes to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OrderCheck {
    /// Rows in the order that the paper has from worst to best.
    pub rows: Vec<OrderedRow>,
    /// Whether those that are there are in this order; `None` with fewer than two.
    pub holds: Option<bool>,
}

/// Both tables.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Tables {
    /// Name of the scene's folder.
    pub scene: String,
    /// Frames that everything is measured on.
    pub test_frames: usize,
    /// A pixel belongs to a phrase where its score is above this, in every row.
    pub threshold: f32,
    /// How often features were trained; figures are means over that.
    pub seeds: u32,
    /// Dynamic objects, by their names.
    pub objects: Vec<TableRow>,
    /// Places of actions, by what is done.
    pub affordances: Vec<TableRow>,
    /// static < patches < masks ≤ masks+boxes on objects.
    pub order: OrderCheck,
    /// mIoU of the video-language field over that of the image-language field on affordances.
    pub video_over_image: Option<f64>,
}

impl OrderCheck {
    /// Whether `rows` rise. The last two may be equal: the last one counts as reaching the one before unless it is lower
    /// by more than the standard error of their difference.
    pub fn new(rows: Vec<OrderedRow>) -> Self {
        let last = rows.len().saturating_sub(1);
        let there: Vec<(usize, f64)> =
            rows.iter().enumerate().filter_map(|(n, r)| Some((n, r.miou?))).collect();
        let noise = |n: usize| rows[n].error.unwrap_or(0.0);
        let rises = |w: &[(usize, f64)]| match w[1].0 == last && w[0].0 + 1 == last {
            true => w[0].1 <= w[1].1 + noise(w[0].0).hypot(noise(w[1].0)),
            false => w[0].1 < w[1].1,
        };
        let holds = (there.len() > 1).then(|| there.windows(2).all(rises));
        Self { rows, holds }
    }

    fn sentence(&self) -> String {
        let last = self.rows.len().saturating_sub(1);
        let mut claim = String::new();
        for (n, row) in self.rows.iter().enumerate() {
            let sign = if n == 0 {
                ""
            } else if n == last {
                " ≤ "
            } else {
                " < "
            };
            let _ = write!(claim, "{sign}{} ({}{})", row.name, percent(row.miou), plus_minus(row.error));
        }
        let missing = self.rows.iter().any(|r| r.miou.is_none());
        let verdict = match self.holds {
            Some(true) if missing => "holds for the rows that are there",
            Some(true) => "holds",
            Some(false) => "DOES NOT HOLD",
            None => "cannot be told",
        };
        format!("Order on objects, {claim}: {verdict}.")
    }
}

impl Tables {
    /// Both tables with their notes, in the paper's order and units (mIoU in percent), the best figures bold.
    pub fn markdown(&self) -> String {
        let mut out = format!(
            "# The paper's tables on {}\n\nmIoU in percent over {} test frames, where the truth covers 50 px or more; a pixel \
             is found where its score is above {THRESHOLD}, in every row. Phrases: mean over their frames. Rows of three \
             streams share one geometry. Seconds are those of training: geometry, and the features of both spaces.{}\n",
            self.scene,
            self.test_frames,
            match self.seeds {
                1 => String::new(),
                n => format!(" Features were trained from {n} seeds: means, ± the standard error."),
            }
        );
        for (task, title) in
            [(Task::Objects, "Dynamic object segmentation"), (Task::Affordances, "Affordance segmentation")]
        {
            let _ = write!(out, "\n## {title}\n\n{}", table(self.rows(task)));
        }
        let ratio = match self.video_over_image {
            Some(ratio) => {
                let verdict = if ratio >= VIDEO_OVER_IMAGE { "reached" } else { "NOT REACHED" };
                format!("{ratio:.2} (at least {VIDEO_OVER_IMAGE} wanted: {verdict}).")
            }
            None => "cannot be told.".to_owned(),
        };
        let _ = write!(
            out,
            "\n## Checks\n\n- {}\n- Video over image inference on affordances: {ratio}\n",
            self.order.sentence()
        );
        out
    }

    /// The rows of a task.
    pub fn rows(&self, task: Task) -> &[TableRow] {
        match task {
            Task::Objects => &self.objects,
            Task::Affordances => &self.affordances,
        }
    }
}

fn table(rows: &[TableRow]) -> String {
    let mut phrases: Vec<&String> = rows.iter().flat_map(|r| r.phrases.keys()).collect();
    phrases.sort();
    phrases.dedup();
    let best = |of: &dyn Fn(&TableRow) -> Option<f64>| rows.iter().filter_map(of).reduce(f64::max);
    let cell = |row: &TableRow, of: &dyn Fn(&TableRow) -> Option<f64>| match of(row) {
        Some(value) if rows.len() > 1 && Some(value) == best(of) => format!("**{}**", percent(Some(value))),
        value => percent(value),
    };
    let mut out = String::from("| Method |");
    phrases.iter().for_each(|phrase| {
        let _ = write!(out, " {} |", phrase.replace('|', "\\|"));
    });
    out.push_str(" mIoU | PSNR, dB | geometry, s | features, s |\n|---|");
    out.push_str(&"---:|".repeat(phrases.len() + 4));
    out.push('\n');
    for row in rows {
        let _ = write!(out, "| {} |", row.method.replace('|', "\\|"));
        for phrase in &phrases {
            let _ = write!(out, " {} |", cell(row, &|r| r.phrases.get(*phrase).copied()));
        }
        let number =
            |value: Option<f64>, digits: usize| value.map_or("–".into(), |v| format!("{v:.digits$}"));
        let _ = writeln!(
            out,
            " {}{} | {} | {} | {} |",
            cell(row, &|r| r.miou),
            plus_minus(row.miou_error),
            number(row.psnr, 2),
            number(row.geometry_seconds, 0),
            number(row.feature_seconds, 0)
        );
    }
    let mut notes = rows.iter().filter_map(|r| Some((&r.method, r.absent.as_ref()?))).peekable();
    if notes.peek().is_some() {
        out.push('\n');
    }
    notes.for_each(|(method, why)| {
        let _ = writeln!(out, "- {method}: no figure: {why}.");
    });
    out
}

fn percent(value: Option<f64>) -> String {
    value.map_or("–".into(), |v| format!("{:.1}", 100.0 * v))
}

/// Nothing without an error.
fn plus_minus(error: Option<f64>) -> String {
    error.map_or(String::new(), |e| format!(" ± {:.1}", 100.0 * e))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(method: &str, miou: f64, mug: f64) -> TableRow {
        let phrases = BTreeMap::from([("mug".to_owned(), mug), ("pan".to_owned(), 0.25)]);
        TableRow { method: method.into(), miou: Some(miou), phrases, ..TableRow::default() }
    }

    fn order(values: [Option<f64>; 4]) -> OrderCheck {
        order_with(values, [None; 4])
    }

    fn order_with(values: [Option<f64>; 4], errors: [Option<f64>; 4]) -> OrderCheck {
        let names = ["static", "patches", "masks", "masks+boxes"];
        let rows = names.into_iter().zip(values.into_iter().zip(errors));
        OrderCheck::new(
            rows.map(|(name, (miou, error))| OrderedRow { name: name.into(), miou, error }).collect(),
        )
    }

    #[test]
    fn repeats_are_averaged_and_their_spread_is_an_error() {
        let one = |miou| TableRow { feature_seconds: Some(100.0 * miou), ..row("A", miou, miou / 2.0) };
        let mean = TableRow::mean([0.5, 0.6, 0.7].map(one).into_iter());
        assert!((mean.miou.unwrap() - 0.6).abs() < 1e-12 && (mean.phrases["mug"] - 0.3).abs() < 1e-12);
        assert!((mean.feature_seconds.unwrap() - 60.0).abs() < 1e-9);
        // Standard deviation 0.1, over √3.
        assert!((mean.miou_error.unwrap() - 0.1 / 3f64.sqrt()).abs() < 1e-12);
        assert_eq!(TableRow::mean([one(0.5)].into_iter()), one(0.5), "one repeat has no error");
    }

    #[test]
    fn the_last_two_are_equal_within_their_noise() {
        let values = [Some(0.0), Some(0.1), Some(0.51), Some(0.5)];
        let holds = |e: f64| order_with(values, [None, None, Some(e), Some(e)]).holds.unwrap();
        assert!(holds(0.008) && !holds(0.006) && !order(values).holds.unwrap());
        let noisy = order_with([Some(0.0), Some(0.0), Some(0.5), Some(0.6)], [Some(0.1); 4]);
        assert_eq!(noisy.holds, Some(false), "the others must really rise");
    }

    #[test]
    fn the_order_is_strict_but_for_the_last_two() {
        let holds = |values: [f64; 4]| order(values.map(Some)).holds.unwrap();
        assert!(holds([0.1, 0.2, 0.3, 0.4]) && holds([0.1, 0.2, 0.3, 0.3]));
        assert!(
            !holds([0.1, 0.2, 0.3, 0.29]) && !holds([0.2, 0.2, 0.3, 0.3]) && !holds([0.1, 0.3, 0.2, 0.4])
        );
        let there = order([None, Some(0.2), None, Some(0.3)]);
        assert_eq!(there.holds, Some(true));
        assert_eq!(
            order([None, Some(0.3), None, Some(0.3)]).holds,
            Some(false),
            "patches and boxes may not be equal"
        );
        assert!(
            there.sentence().ends_with("masks (–) ≤ masks+boxes (30.0): holds for the rows that are there.")
        );
        assert_eq!(order([None, None, None, Some(0.3)]).holds, None);
    }

    #[test]
    fn markdown_has_the_rows_as_given_the_best_bold_and_reasons_below() {
        let timed = TableRow {
            psnr: Some(24.314),
            geometry_seconds: Some(530.3),
            feature_seconds: Some(69.6),
            ..row("B", 0.5, 0.125)
        };
        let absent =
            TableRow { method: "C".into(), absent: Some("there is no text".into()), ..TableRow::default() };
        let tables = Tables {
            scene: "kitchen".into(),
            test_frames: 3,
            threshold: THRESHOLD,
            seeds: 1,
            objects: vec![row("A|1", 0.2, 0.5), timed, absent],
            affordances: vec![],
            order: order([Some(0.1), Some(0.2), Some(0.3), Some(0.4)]),
            video_over_image: Some(1.75),
        };
        let text = tables.markdown();
        let expected = "\
## Dynamic object segmentation

| Method | mug | pan | mIoU | PSNR, dB | geometry, s | features, s |
|---|---:|---:|---:|---:|---:|---:|
| A\\|1 | **50.0** | **25.0** | 20.0 | – | – | – |
| B | 12.5 | **25.0** | **50.0** | 24.31 | 530 | 70 |
| C | – | – | – | – | – | – |

- C: no figure: there is no text.

## Affordance segmentation
";
        assert!(text.contains(expected), "{text}");
        assert!(text.contains("masks (30.0) ≤ masks+boxes (40.0): holds."), "{text}");
        assert!(text.contains("affordances: 1.75 (at least 1.5 wanted: reached)."), "{text}");
        let none = Tables { video_over_image: None, ..tables };
        assert!(none.markdown().contains("affordances: cannot be told."));
    }
}
