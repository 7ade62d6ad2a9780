//! What a sweep found: a row for each setting, written as CSV and Markdown, and its plots.

use std::fmt::Write;

use super::front::{Point, front, recommended};
use crate::report::chart::{Mark, scatter};

/// One value of a row.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// A number.
    Number(f64),
    /// Why there is none.
    Missing(String),
}

impl From<f64> for Cell {
    fn from(value: f64) -> Self {
        Self::Number(value)
    }
}

impl From<usize> for Cell {
    fn from(value: usize) -> Self {
        Self::Number(value as f64)
    }
}

impl From<Option<f64>> for Cell {
    fn from(value: Option<f64>) -> Self {
        value.map_or_else(|| Self::Missing("not measured".to_owned()), Self::Number)
    }
}

impl Cell {
    /// The number, if there is one.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Number(value) => Some(*value),
            Self::Missing(_) => None,
        }
    }

    /// A number with five digits that count, or why there is none.
    fn text(&self) -> String {
        match self {
            Self::Number(v) if *v == 0.0 => "0".to_owned(),
            Self::Number(v) if v.fract() == 0.0 && v.abs() < 1e9 => format!("{v:.0}"),
            Self::Number(v) => {
                let digits = (4.0 - v.abs().log10().floor()).clamp(0.0, 9.0) as usize;
                format!("{v:.digits$}")
            }
            Self::Missing(why) => why.clone(),
        }
    }
}

/// What was measured with one setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its name.
    pub setting: String,
    /// How it is asked for: `train.steps=900`; empty for the settings as they are.
    pub overrides: Vec<String>,
    /// Column and value, the same columns in every row.
    pub values: Vec<(&'static str, Cell)>,
}

impl Row {
    /// A row without values.
    pub fn new(setting: impl Into<String>, overrides: Vec<String>) -> Self {
        Self { setting: setting.into(), overrides, values: Vec::new() }
    }

    /// This row with another value.
    #[must_use]
    pub fn with(mut self, column: &'static str, value: impl Into<Cell>) -> Self {
        self.values.push((column, value.into()));
        self
    }

    fn number(&self, column: &str) -> Option<f64> {
        self.values.iter().find(|(name, _)| *name == column)?.1.number()
    }
}

/// What a plot has upwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Better {
    /// More is better, as with PSNR.
    Higher,
    /// Less is better, as with distances.
    Lower,
}

/// A cost against a measure of quality: two columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plot {
    /// Column of the cost, of which less is better.
    pub cost: &'static str,
    /// Column of the quality.
    pub quality: &'static str,
    /// Its direction.
    pub better: Better,
}

/// All rows of a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Short name and that of its files.
    pub name: &'static str,
    /// What it is about.
    pub title: &'static str,
    /// What was measured.
    pub rows: Vec<Row>,
    /// The first one that has points decides what is recommended.
    pub plots: Vec<Plot>,
    /// What was left out, and why.
    pub notes: Vec<String>,
}

impl Sweep {
    /// Cost and error of each row; NaN where one was not measured.
    fn points(&self, plot: &Plot) -> Vec<Point> {
        let error = |value: f64| if plot.better == Better::Higher { -value } else { value };
        let value = |row: &Row, column| row.number(column).unwrap_or(f64::NAN);
        self.rows.iter().map(|r| [value(r, plot.cost), error(value(r, plot.quality))]).collect()
    }

    fn has_points(&self, plot: &Plot) -> bool {
        !front(&self.points(plot)).is_empty()
    }

    /// The row that is recommended.
    pub fn recommended(&self) -> Option<usize> {
        let plot = self.plots.iter().find(|p| self.has_points(p))?;
        recommended(&self.points(plot))
    }

    /// One line: how the recommended setting is asked for, and what it gives.
    pub fn recommendation(&self) -> String {
        let plot = self.plots.iter().find(|p| self.has_points(p));
        let (Some(n), Some(plot)) = (self.recommended(), plot) else {
            return "nothing is recommended: nothing was measured".to_owned();
        };
        let row = &self.rows[n];
        let how = match row.overrides.as_slice() {
            [] => "the settings as they are".to_owned(),
            all => all.iter().map(|o| format!("--set {o}")).collect::<Vec<_>>().join(" "),
        };
        let said = |column| row.values.iter().find(|v| v.0 == column).map_or(String::new(), |v| v.1.text());
        let (cost, quality) = (said(plot.cost), said(plot.quality));
        format!("recommended: {} ({how}): {} {quality} for {} {cost}", row.setting, plot.quality, plot.cost)
    }

    /// Header and cells of the table: the setting, the columns, for every plot whether the row is on its front, and
    /// whether it is recommended.
    fn cells(&self) -> (Vec<String>, Vec<Vec<String>>) {
        let mut header = vec!["setting".to_owned()];
        header.extend(self.rows.first().iter().flat_map(|r| r.values.iter().map(|v| v.0.to_owned())));
        let mut rows: Vec<Vec<String>> = self
            .rows
            .iter()
            .map(|r| [r.setting.clone()].into_iter().chain(r.values.iter().map(|v| v.1.text())).collect())
            .collect();
        let mut mark = |name: String, marked: &[usize]| {
            header.push(name);
            for (n, row) in rows.iter_mut().enumerate() {
                row.push(usize::from(marked.contains(&n)).to_string());
            }
        };
        for plot in &self.plots {
            mark(format!("front_{}_{}", plot.cost, plot.quality), &front(&self.points(plot)));
        }
        let best: Vec<usize> = self.recommended().into_iter().collect();
        mark("recommended".to_owned(), &best);
        (header, rows)
    }

    /// As CSV (RFC 4180, lines end with a line feed).
    pub fn csv(&self) -> String {
        let (header, rows) = self.cells();
        let quoted = |cell: &String| match cell.contains([',', '"', '\n']) {
            true => format!("\"{}\"", cell.replace('"', "\"\"")),
            false => cell.clone(),
        };
        let line = |cells: &Vec<String>| cells.iter().map(quoted).collect::<Vec<_>>().join(",") + "\n";
        [&header].into_iter().chain(&rows).map(line).collect()
    }

    /// As a table in Markdown.
    pub fn markdown(&self) -> String {
        let (header, rows) = self.cells();
        let line = |cells: &Vec<String>| format!("| {} |\n", cells.join(" | ").replace('\n', " "));
        let rule = format!("|{}\n", "---|".repeat(header.len()));
        rows.iter().fold(line(&header) + &rule, |text, row| text + &line(row))
    }

    /// As a table in HTML; `escaped` makes text harmless.
    pub fn html(&self, escaped: impl Fn(&str) -> String) -> String {
        let (header, rows) = self.cells();
        let line = |cells: &Vec<String>, tag: &str| {
            let cells = cells.iter().enumerate().map(|(n, c)| {
                format!("<{tag}{}>{}</{tag}>", if n > 0 { " class=\"n\"" } else { "" }, escaped(c))
            });
            format!("<tr>{}</tr>", cells.collect::<String>())
        };
        let mut out = String::from("<table>");
        out.push_str(&line(&header, "th"));
        rows.iter().for_each(|row| out.push_str(&line(row, "td")));
        out.push_str("</table>");
        out
    }

    /// File name (without extension) and SVG of each plot that has points.
    pub fn pictures(&self) -> Vec<(String, String)> {
        let picture = |plot: &Plot| {
            let points = self.points(plot);
            let number = |n: usize| {
                let [cost, error] = points[n];
                [cost, if plot.better == Better::Higher { -error } else { error }]
            };
            let (front, best) = (front(&points), self.recommended());
            let known = (0..points.len()).filter(|n| points[*n].iter().all(|v| v.is_finite()));
            let marks: Vec<Mark> = known
                .map(|n| Mark {
                    label: self.rows[n].setting.clone(),
                    at: number(n),
                    on_front: front.contains(&n),
                    best: best == Some(n),
                })
                .collect();
            let svg = scatter(&marks, [plot.cost, plot.quality])?;
            let mut name = String::new();
            // Writing to a String cannot fail.
            let _ = write!(name, "{}_{}_{}", self.name, plot.cost, plot.quality);
            Some((name, svg))
        };
        self.plots.iter().filter_map(picture).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep() -> Sweep {
        let row = |name: &str, seconds: f64, psnr: Cell| {
            let overrides = vec![format!("train.steps={seconds}")];
            Row::new(name, overrides).with("train_s", seconds).with("psnr_db", psnr)
        };
        let missing = Cell::Missing("not installed".into());
        Sweep {
            name: "training",
            title: "Training budget",
            rows: vec![
                row("1/4", 5.0, 18.0.into()),
                row("1/2, so to say", 10.0, 21.5.into()),
                row("worse", 20.0, 21.0.into()),
                row("1", 80.0, 22.0.into()),
                row("none", 3.0, missing),
            ],
            plots: vec![Plot { cost: "train_s", quality: "psnr_db", better: Better::Higher }],
            notes: Vec::new(),
        }
    }

    #[test]
    fn csv_says_what_is_on_the_front_and_recommended() {
        let csv = sweep().csv();
        assert_eq!(
            csv,
            "setting,train_s,psnr_db,front_train_s_psnr_db,recommended\n1/4,5,18,1,0\n\
             \"1/2, so to say\",10,21.500,1,1\nworse,20,21,0,0\n1,80,22,1,0\nnone,3,not installed,0,0\n"
        );
        assert_eq!(sweep().markdown().lines().count(), 7);
        assert_eq!(
            sweep().recommendation(),
            "recommended: 1/2, so to say (--set train.steps=10): psnr_db 21.500 for train_s 10"
        );
    }

    #[test]
    fn plots_mark_the_front() {
        let pictures = sweep().pictures();
        let (name, svg) = &pictures[0];
        assert_eq!((name.as_str(), pictures.len()), ("training_train_s_psnr_db", 1));
        assert_eq!(svg.matches("<circle").count(), 4, "the row without a figure is not drawn");
        assert_eq!(svg.matches("class=\"best\"").count(), 1);
        assert!(svg.contains("1/2, so to say"));
        let nothing = Sweep { rows: Vec::new(), ..sweep() };
        assert!(nothing.pictures().is_empty() && nothing.recommendation().starts_with("nothing"));
    }

    #[test]
    fn numbers_keep_five_digits() {
        let text = |v: f64| Cell::from(v).text();
        assert_eq!([text(0.0), text(1234567.0), text(0.012_345_67)], ["0", "1234567", "0.012346"]);
        assert_eq!([text(12.345_67), text(-0.5), text(f64::NAN)], ["12.346", "-0.50000", "NaN"]);
    }
}
