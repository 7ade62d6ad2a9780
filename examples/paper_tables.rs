//! The DIV-FF paper's two tables on one scene: who finds objects and affordances how well, and what it takes.
//!
//! ```text
//! cargo run --release --example paper_tables -- SCENE --out DIR [--preset standard] [--set a.b=c]
//!     [--rows static,patches,masks,masks+boxes] [--seeds 3] [--detections F.json] [--text-encoder FOLDER]
//! ```
//!
//! Geometry and features are trained once and kept in `DIR`; Ctrl-C stops, and the same command goes on. The results are
//! `DIR/tables.md` and `DIR/tables.json`. `docs/semantics.md` says what the rows are and how to write detections.

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use divff::config::{Config, Preset};
use divff::eval::{Detections, PhraseTruth};
use divff::pipeline::folder::{create_writable, write_json};
use divff::pipeline::tables::{Comparison, Variant, paper_tables};
use divff::pipeline::{Event, Observer};
use divff::scene::Scene;
use divff::scene::features::Space;
use divff::semantics::TextSources;
use divff_exporters::atomic::write_bytes_atomically;

#[derive(Parser)]
#[command(about = "The DIV-FF paper's two tables on one scene")]
struct Arguments {
    /// Scene with features and ground truth
    scene: PathBuf,
    /// Folder for everything that is trained, and for tables.md and tables.json
    #[arg(long)]
    out: PathBuf,
    /// Where settings start from
    #[arg(long, value_enum, default_value = "standard")]
    preset: PresetName,
    /// One setting of all rows, as often as needed: train.steps=9000
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Fields to compare
    #[arg(long, value_delimiter = ',', value_parser = variant, default_value = "static,patches,masks,masks+boxes")]
    rows: Vec<Variant>,
    /// How often the features of each row are trained, from a seed of their own each time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    seeds: u32,
    /// What somebody's detector found in the rendered test views, in COCO's form; a row each
    #[arg(long, value_name = "F.json")]
    detections: Vec<PathBuf>,
    /// Text encoders for phrases that the scene has no embedding of
    #[arg(long, value_name = "FOLDER")]
    text_encoder: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum PresetName {
    Draft,
    Standard,
    Fine,
}

fn variant(name: &str) -> Result<Variant, String> {
    let known = Variant::ALL.map(Variant::name).join(", ");
    Variant::named(name).ok_or_else(|| format!("there are {known}"))
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = Arguments::parse();
    // The first Ctrl-C lets what is being trained be stored, the second does not wait for it.
    ctrlc::set_handler(|| {
        if STOP.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
    })?;
    let mut config = Config::preset(match arguments.preset {
        PresetName::Draft => Preset::Draft,
        PresetName::Standard => Preset::Standard,
        PresetName::Fine => Preset::Fine,
    });
    for setting in &arguments.set {
        config = config.with_setting(setting)?;
    }
    config.validate()?;
    let scene = Scene::open(&arguments.scene)?;
    scene.warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    // What may be wrong with these files should be told before hours of training.
    let truth = PhraseTruth::read(&scene)?;
    let detections = arguments.detections.iter().map(|path| Detections::read(path, &scene, &truth));
    let detections = detections.collect::<Result<Vec<_>, _>>()?;
    let mut text = TextSources::of_scene(&scene)?;
    for space in Space::ALL {
        if let Some(folder) = &arguments.text_encoder {
            text.encode_with(space, folder)?;
        }
    }
    create_writable(&arguments.out)?;
    let (out, seeds) = (&arguments.out, arguments.seeds);
    let (variants, detections) = (&arguments.rows[..], &detections[..]);
    let asked = Comparison { scene: &scene, base: &config, out, variants, detections, text: &text, seeds };
    let Some(tables) = paper_tables(&asked, &mut Log::default())? else {
        return Err("stopped; the same command goes on from there".into());
    };
    write_json(&out.join("tables.json"), &tables)?;
    write_bytes_atomically(&out.join("tables.md"), tables.markdown().as_bytes())?;
    println!("{}", tables.markdown());
    Ok(())
}

/// Set by Ctrl-C.
static STOP: AtomicBool = AtomicBool::new(false);

/// Says on standard error what is being done, every ten seconds.
#[derive(Default)]
struct Log {
    last: Option<Instant>,
}

impl Observer for Log {
    fn event(&mut self, event: &Event) {
        let line = match event {
            Event::Stage(stage) => {
                self.last = None;
                format!("{stage:?} …")
            }
            Event::AlreadyTrained { step } => format!("  already trained ({step} steps)"),
            Event::Resuming { step, .. } => format!("  going on after step {step}"),
            Event::Training(p) => format!("  {:3.0} %  PSNR {:.2} dB", 100.0 * p.fraction, p.psnr),
            Event::Features(p) => {
                format!("  {}: step {}, loss {:.4}", p.what, p.step, p.loss)
            }
            Event::Views { done, total } => format!("  frame {done} of {total}"),
            _ => return,
        };
        if self.last.is_none_or(|last| last.elapsed() > Duration::from_secs(10)) {
            eprintln!("{line}");
            self.last = (!matches!(event, Event::Stage(_))).then(Instant::now);
        }
    }

    fn stop(&self) -> bool {
        STOP.load(Ordering::SeqCst)
    }
}
