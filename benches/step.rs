//! A training step beside the least time that this machine allows for it.
//!
//! `cargo bench --bench step`. Trains `kitchen-a` from the data folder (`$DIVFF_DATA`, else `../shared/data`), or a scene of its
//! own where that is absent, on the standard schedule or one of `DIVFF_STEPS` steps, with products in `DIVFF_PRECISION` (`auto`, `f32`
//! or `bf16`), and looks at some steps of each part of it: at first everything is evaluated, at the end only what is at surfaces.
//!
//! The floor counts what cannot be left out: the cells of density grids that rays pass, each network forward once where a stream
//! has a density and backward where that is not faint, the rows of tables that are read and added to there, and moments that
//! change; for random cells of the density grids, too, networks as far as their densities. Choosing and cutting rays, compositing
//! and loss are not in it.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use divff::config::Config;
use divff::field::Field;
use divff::field::hashgrid::Row;
use divff::field::mlp::Mlp;
use divff::scene::Scene;
use divff::synth::{self, SynthOptions};
use divff::train::step::StepReport;
use divff::train::{TrainError, Trainer};

#[path = "../tests/support/data.rs"]
mod data;
mod machine;
use machine::{LEVEL_ROWS, Machine};

/// Parts of the schedule, in the middle of each of which steps are looked at.
const PARTS: usize = 8;

/// Steps that are looked at together.
const STEPS: usize = 20;

/// What a step has to do at least.
#[derive(Default)]
struct Work {
    flops: f64,
    /// Rows read and rows added to, of tables of so many rows each.
    rows: BTreeMap<usize, [f64; 2]>,
    cells: f64,
    bytes: f64,
}

impl Work {
    fn add(&mut self, field: &Field, report: &StepReport) {
        // The actor's grid, which is looked at near the camera only, is left out.
        let grids = field.nets[..2].iter().flatten().count();
        self.cells += report.taken as f64 * grids as f64;
        for (s, net) in field.nets.iter().enumerate() {
            let Some(net) = net else { continue };
            let (all, faint) = (report.evaluations[s] as f64, report.faint[s] as f64);
            let (kept, refreshed) = (all - faint, report.refreshed[s] as f64);
            let nets = [&net.trunk, &net.head];
            let both_ways: usize =
                nets.iter().map(|net| net.multiply_adds() + net.multiply_adds_backward()).sum();
            let density = density(&net.trunk);
            self.flops += 2.0 * ((faint + refreshed) * density as f64 + kept * both_ways as f64);
            for (level, table) in net.encoding.levels.iter().zip(&field.tables[s]) {
                let corners = level.corners() as f64;
                let [read, added] = self.rows.entry(table.len()).or_default();
                *read += corners * (all + refreshed);
                *added += corners * kept;
            }
        }
        // Values and two moments are read and written; gradients need not leave a near cache.
        self.bytes += (6 * report.rows.updated * size_of::<Row>()) as f64;
    }

    /// Least seconds for networks, rows, moments and cells.
    fn seconds(&self, machine: &Machine, flops: f64) -> [f64; 4] {
        let rows = self.rows.iter().map(|(table, [read, added])| {
            let rates = machine.rows(*table);
            read / rates[0] + added / rates[1]
        });
        // A cell is read as fast as a row, if its grid were in a near cache.
        let cells = self.cells / machine.rows(LEVEL_ROWS)[0];
        [self.flops / flops, rows.sum(), self.bytes / machine.bytes, cells]
    }
}

/// Multiply-adds of a trunk of which only the first outputs are wanted, the density's.
fn density(trunk: &Mlp) -> usize {
    let [before, outputs] = trunk.shapes().last().unwrap_or_default();
    trunk.multiply_adds() - before * (outputs - 4)
}

/// Steps of one part of the schedule, or of all.
#[derive(Clone, Copy, Default)]
struct Looked {
    steps: usize,
    evaluations: usize,
    /// Seconds that networks, rows, moments and cells take at least.
    floor: [f64; 4],
    /// Seconds of all, of placing, the tables, evaluating and updating all else.
    seconds: [f64; 5],
}

impl Looked {
    /// Takes [`STEPS`] steps at the share `fraction` of the schedule, on what can do `flops` operations a second.
    fn at(trainer: &mut Trainer, fraction: f64, machine: &Machine, flops: f64) -> Result<Self, TrainError> {
        let (mut looked, mut work) = (Self { steps: STEPS, ..Self::default() }, Work::default());
        let start = Instant::now();
        let reports = trainer.steps(fraction, STEPS)?;
        looked.seconds[0] = start.elapsed().as_secs_f64();
        for report in reports {
            (0..4).for_each(|n| looked.seconds[1 + n] += report.seconds[n]);
            looked.evaluations += report.evaluations.iter().sum::<usize>();
            work.add(&trainer.trained().field, &report);
        }
        looked.floor = work.seconds(machine, flops);
        Ok(looked)
    }

    fn add(&mut self, other: &Self) {
        self.steps += other.steps;
        self.evaluations += other.evaluations;
        self.floor.iter_mut().zip(other.floor).for_each(|(sum, x)| *sum += x);
        self.seconds.iter_mut().zip(other.seconds).for_each(|(sum, x)| *sum += x);
    }

    fn print(&self, name: &str) {
        let mean = |seconds: f64| 1e3 * seconds / self.steps as f64;
        let floor = self.floor.iter().sum::<f64>();
        print!("{name:>5} {:>11}", self.evaluations / self.steps);
        for (seconds, width) in self.floor.into_iter().zip([9, 5, 8, 6]) {
            print!(" {:>width$.1}", mean(seconds));
        }
        print!(" {:>9.1}", mean(floor));
        for (seconds, width) in self.seconds.into_iter().zip([6, 8, 9, 11, 9]) {
            print!(" {:>width$.1}", mean(seconds));
        }
        println!(" {:>7.0} %", 100.0 * floor / self.seconds[0]);
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let scene = Scene::open(&scene_folder(folder.path())?)?;
    let mut config = Config::default();
    if let Ok(steps) = std::env::var("DIVFF_STEPS") {
        config.train.steps = steps.parse()?;
    }
    if let Ok(precision) = std::env::var("DIVFF_PRECISION") {
        config.train.precision = serde_json::from_value(precision.into())?;
    }
    let steps = config.train.steps;
    let mut trainer = Trainer::new(&scene, &config)?;
    let threads = rayon::current_num_threads();
    let rows: usize = trainer.trained().field.tables.iter().flatten().map(Vec::len).sum();
    let bf16 = config.train.precision.is_bf16();
    println!(
        "   at evaluations  networks  rows  moments  cells  floor/ms   time  placing    tables  evaluating  updating    floor"
    );
    let mut all = Looked::default();
    for part in 0..PARTS {
        let fraction = (part as f64 + 0.5) / PARTS as f64;
        let before = (fraction * steps as f64) as u64;
        eprintln!("training {before} of {steps} steps");
        trainer.run(folder.path(), None, &mut |p| {
            if p.step >= before { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })?;
        // Right before, since the machine may not be ours alone; of values and two moments.
        let machine = Machine::measure(threads, 3 * rows * size_of::<Row>());
        let (flops, kind) = if bf16 { (machine.bf16_flops, "bf16") } else { (machine.flops, "f32") };
        let [read, added] = machine.rows(LEVEL_ROWS);
        eprintln!(
            "{threads} threads: {:.0} GFLOP/s in {kind}, {:.0} M rows of 2 MiB read and {:.0} M added to a second, {:.1} GB/s",
            flops / 1e9,
            read / 1e6,
            added / 1e6,
            machine.bytes / 1e9
        );
        let looked = Looked::at(&mut trainer, fraction, &machine, flops)?;
        looked.print(&format!("{:.0} %", 100.0 * fraction));
        all.add(&looked);
    }
    all.print("all");
    Ok(())
}

/// The scene that is trained.
fn scene_folder(own: &Path) -> Result<PathBuf, Box<dyn std::error::Error>> {
    if let Some(kitchen) = data::scene("kitchen-a") {
        return Ok(kitchen);
    }
    eprintln!("training a synthetic scene instead");
    let scene = own.join("scene");
    synth::generate(&SynthOptions::default(), &scene)?;
    Ok(scene)
}
