//! `divff bench`.

use std::fs;
use std::path::Path;

use crate::kit::{arg, divff, files, folder, scene, tiny};

/// Header and rows of a CSV whose cells hold no comma.
fn table(path: &Path) -> (Vec<String>, Vec<Vec<String>>) {
    let text = fs::read_to_string(path).unwrap();
    let mut lines = text.lines().map(|l| l.split(',').map(str::to_owned).collect::<Vec<_>>());
    (lines.next().unwrap(), lines.collect())
}

#[test]
fn a_quick_bench_writes_tables_plots_and_recommendations() {
    let out = folder("bench");
    let few = ["--sweeps", "training,voxel,simplify,export", "--set", "semantics.joint_steps=0"];
    let bench = ["bench", arg(scene()), "--out", arg(&out), "--quick", "--config", arg(tiny())];
    let text = divff(&[&bench[..], &few[..]].concat()).ok();
    assert_eq!(text.matches("recommended: ").count(), 6, "{text}");

    let (header, rows) = table(&out.join("training.csv"));
    let column =
        |name: &str| header.iter().position(|c| c == name).unwrap_or_else(|| panic!("{name}: {header:?}"));
    let number = |row: &[String], name: &str| row[column(name)].parse::<f64>().unwrap();
    assert_eq!(rows.iter().map(|r| number(r, "steps")).collect::<Vec<_>>(), [100.0, 200.0, 400.0]);
    let front = "front_train_s_psnr_db";
    for row in &rows {
        // Whoever is on the front is beaten by nobody in both, and whoever is not is.
        let beaten = rows.iter().any(|other| {
            let ahead = |name, sign: f64| sign * (number(other, name) - number(row, name));
            let (cheaper, better) = (-ahead("train_s", 1.0), ahead("psnr_db", 1.0));
            cheaper >= 0.0 && better >= 0.0 && cheaper + better > 0.0
        });
        assert_eq!(row[column(front)], if beaten { "0" } else { "1" }, "{rows:?}");
    }
    assert_eq!(rows.iter().filter(|r| r[column("recommended")] == "1").count(), 1);

    let (header, rows) = table(&out.join("voxel.csv"));
    for name in ["triangles", "chamfer_m", "extract_s", "dense_march_s", "skimage_ratio"] {
        assert!(header.iter().any(|c| c == name), "{name}: {header:?}");
    }
    assert_eq!(rows.len(), 4);
    let (header, rows) = table(&out.join("simplify.csv"));
    let column = |name: &str| header.iter().position(|c| c == name).unwrap();
    let numbers =
        |name: &str| rows.iter().map(|r| r[column(name)].parse::<f64>().unwrap()).collect::<Vec<_>>();
    assert!(numbers("triangles").windows(2).all(|w| w[1] < w[0]), "{rows:?}");
    assert!(numbers("hausdorff_m")[1..].iter().all(|e| *e > 0.0 && *e < 0.1), "{rows:?}");
    assert!(numbers("feature_error").iter().all(|e| *e < 0.5), "{rows:?}");
    for (content, ways) in [("points", 5), ("mesh", 3), ("view", 7)] {
        let (header, rows) = table(&out.join(format!("export_{content}.csv")));
        let error = header.iter().position(|c| c == "error").unwrap();
        assert_eq!(rows.len(), ways, "{rows:?}");
        for row in &rows {
            let lost: f64 = row[error].parse().unwrap();
            // Half precision rounds to a 2000th of a value, which may be more of a narrow range.
            let rounds = row[0].contains("f16") || row[0].contains("PXR24");
            assert!(if rounds { lost < 1e-2 } else { lost < 1e-6 }, "{row:?}");
        }
    }

    let names = files(&out);
    for name in ["index.html", "bench.md", "voxel_triangles_chamfer_m.svg", "training_train_s_psnr_db.svg"] {
        assert!(names.iter().any(|n| n == name), "{name}: {names:?}");
    }
    let page = fs::read_to_string(out.join("index.html")).unwrap();
    assert!(page.contains("<svg") && page.contains("recommended: ") && !page.contains("https://"));

    // What was trained is not trained again.
    let again = divff(&[&bench[..], &few[..]].concat());
    assert!(again.err.matches("already trained").count() >= 3, "{}", again.err);
    again.ok();
    divff(&["bench", arg(scene()), "--out", arg(&out), "--sweeps", "speed"]).usage("speed");
}
