//! All sweeps on one page, as Markdown and as HTML.

use std::fmt::Write;

use super::Sweep;
use crate::report::html::{STYLE, escaped};
use crate::scene::{Scene, Split};

fn title(scene: &Scene) -> String {
    let name = scene.root.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned());
    let test = scene.frames.iter().filter(|f| f.split == Split::Test).count();
    format!("Benchmark on {name}: {} frames, {test} held out", scene.frames.len())
}

/// `bench.md`.
pub(super) fn markdown(scene: &Scene, sweeps: &[Sweep]) -> String {
    let mut out = format!("# {}\n", title(scene));
    for sweep in sweeps {
        // Writing to a String cannot fail.
        let _ = write!(out, "\n## {}\n\n{}\n\n{}", sweep.title, sweep.recommendation(), sweep.markdown());
        for note in &sweep.notes {
            let _ = write!(out, "\n{note}\n");
        }
        for (name, _) in sweep.pictures() {
            let _ = write!(out, "\n![{name}]({name}.svg)\n");
        }
    }
    out
}

/// `index.html`; needs no other file.
pub(super) fn html(scene: &Scene, sweeps: &[Sweep]) -> String {
    let title = escaped(&title(scene));
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>{title} – divff</title><style>\n{STYLE}</style></head><body><main>\n\
         <header><h1>{title}</h1><p>lines join the settings that no other one beats in both; the large point is \
         recommended</p></header>\n"
    );
    for sweep in sweeps {
        let (heading, line) = (escaped(sweep.title), escaped(&sweep.recommendation()));
        let _ = write!(out, "<section><h2>{heading}</h2><p>{line}</p>{}", sweep.html(escaped));
        for note in &sweep.notes {
            let _ = write!(out, "<p class=\"note\">{}</p>", escaped(note));
        }
        for (_, svg) in sweep.pictures() {
            out.push_str(&svg);
        }
        out.push_str("</section>\n");
    }
    out.push_str("</main></body></html>\n");
    out
}
