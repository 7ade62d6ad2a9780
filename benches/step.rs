//! A training step beside the least time that this machine allows for it.
//!
//! `cargo bench --bench step`. Trains `kitchen-a` from the data folder (`$DIVFF_DATA`, else `../shared/data`), or a scene of its
//! own where that is absent, on the standard schedule or one of `DIVFF_STEPS` steps, and looks at some steps of each part of it:
//! at first everything is evaluated, at the end only what is at surfaces.
//!
//! The floor counts what cannot be left out: the cells of density grids that rays pass, each network forward once where a stream
//! has a density and backward where that is not faint, the rows of tables that are read and added to there, and moments that
//! change; for random cells of the density grids, too, networks as far as their densities. Choosing and cutting rays, compositing
//! and loss are not in it.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use divff::config::Config;
use divff::field::Field;
use divff::field::hashgrid::Row;
use divff::field::mlp::{Mlp, Precision};
use divff::scene::Scene;
use divff::simd::matrix;
use divff::synth::{self, SynthOptions};
use divff::train::step::StepReport;
use divff::train::{TrainError, Trainer};

mod machine;
use machine::Machine;

/// Parts of the schedule, in the middle of each of which steps are looked at.
const PARTS: usize = 8;

/// Steps that are looked at together.
const STEPS: usize = 20;

/// What a step has to do at least.
#[derive(Clone, Copy, Default)]
struct Work {
    flops: f64,
    read_rows: f64,
    cells: f64,
    added_rows: f64,
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
            let [whole, density] =
                [net.trunk.multiply_adds() + net.head.multiply_adds(), density(&net.trunk)];
            // Backward, the gradients of inputs and of weights take as much as forward each.
            self.flops += 2.0 * ((faint + refreshed) * density as f64 + 3.0 * kept * whole as f64);
            for level in &net.encoding.levels {
                let corners = level.corners() as f64;
                self.read_rows += corners * (all + refreshed);
                self.added_rows += corners * kept;
            }
        }
        // Values and two moments are read and written; gradients need not leave a near cache.
        self.bytes += (6 * report.updated * size_of::<Row>()) as f64;
    }

    /// Least seconds for networks, rows, moments and cells.
    fn seconds(&self, machine: &Machine, flops: f64) -> [f64; 4] {
        let rows = self.read_rows / machine.rows + self.added_rows / machine.added_rows;
        // A cell is read as fast as a row, if its grid were in a near cache.
        [self.flops / flops, rows, self.bytes / machine.bytes, self.cells / machine.rows]
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
    seconds: f64,
    /// Placing, encoding, evaluating and updating.
    phases: [f64; 4],
    evaluations: usize,
    work: Work,
}

impl Looked {
    /// Takes [`STEPS`] steps at the share `fraction` of the schedule.
    fn at(trainer: &mut Trainer, fraction: f64) -> Result<Self, TrainError> {
        let mut looked = Self::default();
        for _ in 0..STEPS {
            let start = Instant::now();
            let report = trainer.step(fraction, None)?;
            looked.seconds += start.elapsed().as_secs_f64();
            looked.work.add(&trainer.trained().field, &report);
            looked.evaluations += report.evaluations.iter().sum::<usize>();
            (0..4).for_each(|n| looked.phases[n] += report.seconds[n]);
            looked.steps += 1;
        }
        Ok(looked)
    }

    fn add(&mut self, other: &Self) {
        self.steps += other.steps;
        self.seconds += other.seconds;
        (0..4).for_each(|n| self.phases[n] += other.phases[n]);
        self.evaluations += other.evaluations;
        let (work, more) = (&mut self.work, &other.work);
        work.flops += more.flops;
        work.read_rows += more.read_rows;
        work.cells += more.cells;
        work.added_rows += more.added_rows;
        work.bytes += more.bytes;
    }

    fn print(&self, name: &str, machine: &Machine, flops: f64) {
        let mean = |seconds: f64| 1e3 * seconds / self.steps as f64;
        let parts = self.work.seconds(machine, flops);
        let (floor, phases) = (parts.iter().sum::<f64>(), self.phases.map(mean));
        println!(
            "{name:>5} {:>11} {:>9.1} {:>5.1} {:>8.1} {:>6.1} {:>9.1} {:>5.1} {:>8.1} {:>9.1} {:>11.1} {:>9.1} {:>7.0} %",
            self.evaluations / self.steps,
            mean(parts[0]),
            mean(parts[1]),
            mean(parts[2]),
            mean(parts[3]),
            mean(floor),
            mean(self.seconds),
            phases[0],
            phases[1],
            phases[2],
            phases[3],
            100.0 * floor / self.seconds
        );
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let scene = Scene::open(&scene_folder(folder.path())?)?;
    let mut config = Config::default();
    if let Ok(steps) = std::env::var("DIVFF_STEPS") {
        config.train.steps = steps.parse()?;
    }
    let steps = config.train.steps;
    let mut trainer = Trainer::new(&scene, &config)?;
    let (mut parts, mut all) = (Vec::new(), Looked::default());
    for part in 0..PARTS {
        let fraction = (part as f64 + 0.5) / PARTS as f64;
        let before = (fraction * steps as f64) as u64;
        eprintln!("training {before} of {steps} steps");
        trainer.run(folder.path(), None, &mut |p| {
            if p.step >= before { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })?;
        let looked = Looked::at(&mut trainer, fraction)?;
        all.add(&looked);
        parts.push((fraction, looked));
    }

    let threads = rayon::current_num_threads();
    let field = &trainer.trained().field;
    let rows: usize = field.tables.iter().flatten().map(Vec::len).sum();
    // Values and two moments.
    let machine = Machine::measure(threads, 3 * rows * size_of::<Row>());
    let bf16 = match config.train.precision {
        Precision::Auto => matrix::available(),
        precision => precision == Precision::Bf16,
    };
    let (flops, kind) = if bf16 { (machine.bf16_flops, "bf16") } else { (machine.flops, "f32") };
    println!(
        "machine, {threads} threads: {:.0} GFLOP/s in {kind}, {:.0} M random rows read and {:.0} M added to a second, \
         {:.1} GB/s",
        flops / 1e9,
        machine.rows / 1e6,
        machine.added_rows / 1e6,
        machine.bytes / 1e9
    );
    let mean = |total: f64| total / all.steps as f64;
    println!(
        "a step: {:.2} GFLOP, {:.1} M rows read and {:.1} M added to, {:.0} MB of moments, {:.1} M cells passed",
        mean(all.work.flops) / 1e9,
        mean(all.work.read_rows) / 1e6,
        mean(all.work.added_rows) / 1e6,
        mean(all.work.bytes) / 1e6,
        mean(all.work.cells) / 1e6
    );
    println!(
        "   at evaluations  networks  rows  moments  cells  floor/ms  time  placing  encoding  evaluating  updating    floor"
    );
    for (fraction, looked) in &parts {
        looked.print(&format!("{:.0} %", 100.0 * fraction), &machine, flops);
    }
    all.print("all", &machine, flops);
    Ok(())
}

/// The scene that is trained.
fn scene_folder(own: &Path) -> Result<PathBuf, Box<dyn std::error::Error>> {
    let data = std::env::var_os("DIVFF_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let kitchen = data.join("kitchen-a");
    if kitchen.exists() {
        return Ok(kitchen);
    }
    eprintln!("no kitchen-a in {}: a synthetic scene instead; set DIVFF_DATA", data.display());
    let scene = own.join("scene");
    synth::generate(&SynthOptions::default(), &scene)?;
    Ok(scene)
}
