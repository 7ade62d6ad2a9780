//! The page itself.

use std::fmt::{Display, Write};

use super::colour::STREAM_COLOURS;
use crate::eval::surface::SurfaceMetrics;
use crate::pipeline::RunMetrics;
use crate::scene::{Scene, Split};

pub(crate) const STYLE: &str = include_str!("style.css");

/// Everything that the page shows.
pub struct Page<'a> {
    /// Name of the scene.
    pub title: String,
    /// The scene.
    pub scene: &'a Scene,
    /// What was measured.
    pub metrics: RunMetrics,
    /// SVG of the training curve.
    pub curve: Option<String>,
    /// Pictures per test frame.
    pub views: Vec<Vec<Figure>>,
    /// Pictures per phrase.
    pub queries: Vec<Vec<Figure>>,
    /// Pictures of the map.
    pub meshes: Vec<Figure>,
    /// Files of the map.
    pub files: Vec<FileRow>,
    /// The settings, TOML.
    pub config: String,
}

/// A picture with its caption.
pub struct Figure {
    address: String,
    caption: String,
}

impl Figure {
    /// `address` is what goes into `src`.
    pub fn new(address: String, caption: String) -> Self {
        Self { address, caption }
    }
}

/// A file of the map.
pub struct FileRow {
    /// Relative to the run.
    pub path: String,
    /// Size.
    pub bytes: u64,
    /// Vertices or points.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
}

impl Page<'_> {
    /// The page as HTML.
    pub fn render(&self) -> String {
        let title = escaped(&self.title);
        let mut out = format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
             <title>{title} – divff</title><style>\n{STYLE}</style></head><body><main>\n\
             <header><h1>{title}</h1>{}</header>\n",
            self.subtitle()
        );
        self.figures(&mut out);
        self.pictures(&mut out);
        self.phrases(&mut out);
        self.surfaces(&mut out);
        self.training(&mut out);
        self.table_of_files(&mut out);
        self.skipped(&mut out);
        let config = escaped(&self.config);
        section(&mut out, "", |out| {
            add(out, format_args!("<details><summary>Settings</summary><pre>{config}</pre></details>"));
        });
        out.push_str("</main></body></html>\n");
        out
    }

    fn subtitle(&self) -> String {
        let train = self.scene.frames.iter().filter(|f| f.split == Split::Train).count();
        let (width, height) = self.scene.frames.first().map_or((0, 0), |f| (f.camera.width, f.camera.height));
        format!(
            "<p>{train} frames of {width} × {height} px trained on, {} held out; made by divff {}</p>",
            self.scene.frames.len() - train,
            env!("CARGO_PKG_VERSION")
        )
    }

    fn figures(&self, out: &mut String) {
        let (q, c) = (&self.metrics.quality, &self.metrics.cost);
        let f = |v: Option<f64>, digits: usize, unit: &str| v.map(|v| format!("{v:.digits$}{unit}"));
        let all = [
            ("PSNR of held-out frames", f(q.psnr, 2, " dB")),
            ("PSNR of what stays", f(q.psnr_persistent, 2, " dB")),
            ("SSIM", f(q.ssim, 3, "")),
            ("depth error, median", f(q.depth_median_abs_m, 3, " m")),
            ("streams, mean IoU", f(q.stream_miou, 3, "")),
            ("objects by phrase, mean IoU", f(q.object_miou, 3, "")),
            ("affordances by phrase, mean IoU", f(q.affordance_miou, 3, "")),
            ("surface, chamfer", f(q.persistent.as_ref().map(|s| s.chamfer_m), 3, " m")),
            ("surface, F-score at 5 cm", f(q.persistent.as_ref().map(|s| s.fscore_5cm), 3, "")),
            ("training", f(c.train_seconds, 0, " s")),
            ("training of features", f(c.feature_seconds, 0, " s")),
            ("map from the field", f(c.extract_seconds, 1, " s")),
            ("writing the map", f(c.export_seconds, 1, " s")),
            ("field evaluations a second", f(c.samples_per_second.map(|v| v / 1e6), 1, " M")),
            ("memory, at most", f(c.peak_rss_mb, 0, " MB")),
        ];
        section(out, "At a glance", |out| {
            out.push_str("<div class=\"figures\">");
            for (name, value) in all.iter().filter_map(|(name, v)| v.as_ref().map(|v| (name, v))) {
                add(out, format_args!("<div class=\"figure\"><b>{value}</b><span>{name}</span></div>"));
            }
            out.push_str("</div>");
            for (what, why) in &q.absent {
                let (what, why) = (escaped(what), escaped(why));
                add(out, format_args!("<p class=\"note\">{what}: not measured, {why}</p>"));
            }
        });
    }

    fn pictures(&self, out: &mut String) {
        if !self.meshes.is_empty() {
            section(out, "The map", |out| row(out, "row meshes", &self.meshes));
        }
        if !self.views.is_empty() {
            section(out, "Held-out frames", |out| {
                self.views.iter().for_each(|figures| row(out, "row views", figures));
                out.push_str("<p class=\"note key\">streams:");
                for (name, [r, g, b]) in ["persistent", "dynamic", "actor"].iter().zip(STREAM_COLOURS) {
                    add(out, format_args!("<i style=\"background: rgb({r} {g} {b})\"></i>{name}"));
                }
                out.push_str("</p>");
            });
        }
    }

    fn phrases(&self, out: &mut String) {
        if self.queries.is_empty() {
            return;
        }
        section(out, "Phrases in held-out frames", |out| {
            self.queries.iter().for_each(|figures| row(out, "row views", figures));
            out.push_str(
                "<p class=\"note\">A score of 0.5 means: as close to the phrase as to the nearest canonical \
                 phrase. It is no probability.</p>",
            );
        });
    }

    fn surfaces(&self, out: &mut String) {
        let q = &self.metrics.quality;
        let all = [("persistent", &q.persistent), ("dynamic", &q.dynamic), ("actor", &q.actor)];
        let there: Vec<(&str, &SurfaceMetrics)> =
            all.iter().filter_map(|(name, s)| s.as_ref().map(|s| (*name, s))).collect();
        if there.is_empty() {
            return;
        }
        section(out, "Surfaces against the truth", |out| {
            table(out, &["stream", "accuracy", "completeness", "chamfer", "F at 2 cm", "F at 5 cm", "times"]);
            for (name, s) in there {
                let times = s.times.map_or("–".to_owned(), |t| t.to_string());
                cells(
                    out,
                    name,
                    &[
                        format!("{:.4} m", s.accuracy_m),
                        format!("{:.4} m", s.completeness_m),
                        format!("{:.4} m", s.chamfer_m),
                        format!("{:.3}", s.fscore_2cm),
                        format!("{:.3}", s.fscore_5cm),
                        times,
                    ],
                );
            }
            out.push_str("</table>");
        });
    }

    fn training(&self, out: &mut String) {
        let Some(curve) = &self.curve else { return };
        section(out, "Training", |out| {
            out.push_str(curve);
            out.push_str(
                "<p class=\"note key\">PSNR of<i style=\"background: var(--accent)\"></i>training rays\
                 <i style=\"background: var(--test)\"></i>held-out frames (some of their pixels)</p>",
            );
        });
    }

    fn table_of_files(&self, out: &mut String) {
        if self.files.is_empty() {
            return;
        }
        section(out, "Files", |out| {
            table(out, &["file", "size", "vertices", "triangles"]);
            for f in &self.files {
                let path = escaped(&f.path);
                let link = format!("<a href=\"{path}\">{path}</a>");
                let count = |n: usize| if n == 0 { "–".to_owned() } else { n.to_string() };
                cells(out, &link, &[size(f.bytes), count(f.vertices), count(f.triangles)]);
            }
            out.push_str("</table>");
        });
    }

    fn skipped(&self, out: &mut String) {
        if self.metrics.skipped.is_empty() {
            return;
        }
        section(out, "Skipped", |out| {
            table(out, &["what", "how much"]);
            for (what, value) in &self.metrics.skipped {
                if let serde_json::Value::Object(reasons) = value {
                    for (item, why) in reasons {
                        let item = format!("{what}: {}", item.replace('_', " "));
                        cells(out, &escaped(&item), &[escaped(&reason(why))]);
                    }
                    continue;
                }
                let value = match value {
                    serde_json::Value::Array(all) if all.is_empty() => "none".to_owned(),
                    serde_json::Value::Array(all) => {
                        all.iter().map(|v| v.as_str().unwrap_or_default()).collect::<Vec<_>>().join(", ")
                    }
                    serde_json::Value::Number(n) if n.is_f64() => {
                        format!("{:.3}", n.as_f64().unwrap_or_default())
                    }
                    serde_json::Value::String(text) => text.clone(),
                    other => other.to_string(),
                };
                cells(out, &escaped(&what.replace('_', " ")), &[escaped(&value)]);
            }
            out.push_str("</table>");
        });
    }
}

/// Writing to a String cannot fail.
fn add(out: &mut String, text: impl Display) {
    let _ = write!(out, "{text}");
}

fn section(out: &mut String, title: &str, inside: impl FnOnce(&mut String)) {
    out.push_str("<section>");
    if !title.is_empty() {
        add(out, format_args!("<h2>{title}</h2>"));
    }
    inside(out);
    out.push_str("</section>\n");
}

fn row(out: &mut String, class: &str, figures: &[Figure]) {
    add(out, format_args!("<div class=\"{class}\">"));
    for f in figures {
        let caption = escaped(&f.caption);
        add(
            out,
            format_args!(
                "<figure><img src=\"{}\" alt=\"{caption}\"><figcaption>{caption}</figcaption></figure>",
                f.address
            ),
        );
    }
    out.push_str("</div>");
}

fn table(out: &mut String, heads: &[&str]) {
    out.push_str("<table><tr>");
    for (n, head) in heads.iter().enumerate() {
        add(out, format_args!("<th{}>{head}</th>", if n > 0 { " class=\"n\"" } else { "" }));
    }
    out.push_str("</tr>");
}

fn cells(out: &mut String, first: &str, others: &[String]) {
    add(out, format_args!("<tr><td>{first}</td>"));
    for other in others {
        add(out, format_args!("<td class=\"n\">{other}</td>"));
    }
    out.push_str("</tr>");
}

fn size(bytes: u64) -> String {
    match bytes {
        0..1_000 => format!("{bytes} B"),
        1_000..1_000_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        _ => format!("{:.1} MB", bytes as f64 / 1e6),
    }
}

pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Why something was skipped, or what work that saved: `5000 samples, 12 bytes`.
fn reason(why: &serde_json::Value) -> String {
    let amount = |(unit, n): (&String, &serde_json::Value)| match n.as_u64() {
        Some(n) => format!("{n} {unit}"),
        None => format!("{:.1} {unit}", n.as_f64().unwrap_or_default()),
    };
    match why {
        serde_json::Value::Object(work) => work.iter().map(amount).collect::<Vec<_>>().join(", "),
        other => other.as_str().unwrap_or_default().to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_break_the_page() {
        assert_eq!(escaped("<a href=\"x\">&"), "&lt;a href=&quot;x&quot;&gt;&amp;");
    }

    #[test]
    fn sizes_are_told_in_the_unit_that_fits() {
        assert_eq!([size(999), size(1500), size(2_500_000)], ["999 B", "1.5 kB", "2.5 MB"]);
    }
}
