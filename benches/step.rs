//! A training step beside the least time that this machine allows for it.
//!
//! `cargo bench --bench step`. Trains `kitchen-a` from the data folder (`$DIVFF_DATA`, else `../shared/data`), or a scene of its
//! own where that is absent, on a schedule of `DIVFF_STEPS` steps (1500), and looks at the last of them, where surfaces are sharp.
//!
//! The floor counts what cannot be left out: the cells of density grids that rays pass, each network forward once where a stream
//! has a density and backward where that is not faint, the rows of tables that are read and added to there, and moments that
//! change. Choosing and cutting rays, compositing, loss and what the density grids are told are not in it.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use divff::config::Config;
use divff::field::Field;
use divff::field::encoding::Level;
use divff::field::hashgrid::Row;
use divff::field::mlp::{Mlp, Precision};
use divff::scene::Scene;
use divff::simd::matrix;
use divff::synth::{self, SynthOptions};
use divff::train::Trainer;
use divff::train::step::StepReport;

mod machine;
use machine::Machine;

/// Steps that are looked at.
const STEPS: usize = 100;

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
            let kept = all - faint;
            let [whole, density] =
                [net.trunk.multiply_adds() + net.head.multiply_adds(), density(&net.trunk)];
            // Backward, the gradients of inputs and of weights take as much as forward each.
            self.flops += 2.0 * (faint * density as f64 + 3.0 * kept * whole as f64);
            for level in &net.encoding.levels {
                let Level::Lattice(lattice) = level else { continue };
                let corners = if lattice.time_scale > 0.0 { 16.0 } else { 8.0 };
                self.read_rows += corners * all;
                self.added_rows += corners * kept;
            }
            if all > 0.0 {
                // Values, gradients and two moments are read and written.
                let rows: usize = net.encoding.levels.iter().map(Level::rows).sum();
                self.bytes += (8 * rows * size_of::<Row>()) as f64;
            }
        }
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

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let scene = Scene::open(&scene_folder(folder.path())?)?;
    let mut config = Config::default();
    config.train.steps = std::env::var("DIVFF_STEPS").map_or(Ok(1500), |v| v.parse())?;
    let before = config.train.steps.saturating_sub(STEPS as u64);
    let mut trainer = Trainer::new(&scene, &config)?;
    eprintln!("training {before} of {} steps", config.train.steps);
    trainer.run(folder.path(), None, &mut |p| {
        if p.step >= before { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    let fraction = before as f64 / config.train.steps as f64;
    let (mut times, mut work, mut evaluations) = (Vec::new(), Work::default(), 0);
    let mut phases = [0.0; 4];
    for _ in 0..STEPS {
        let start = Instant::now();
        let report = trainer.step(fraction, None)?;
        times.push(1e3 * start.elapsed().as_secs_f64());
        work.add(&trainer.trained().field, &report);
        evaluations += report.evaluations.iter().sum::<usize>();
        (0..4).for_each(|n| phases[n] += 1e3 * report.seconds[n] / STEPS as f64);
    }
    times.sort_by(f64::total_cmp);

    let threads = rayon::current_num_threads();
    let machine = Machine::measure(threads);
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
    let mean = |total: f64| total / STEPS as f64;
    println!(
        "a step: {} evaluations, {:.2} GFLOP, {:.1} M rows read and {:.1} M added to, {:.0} MB of moments, \
         {:.1} M cells passed",
        evaluations / STEPS,
        mean(work.flops) / 1e9,
        mean(work.read_rows) / 1e6,
        mean(work.added_rows) / 1e6,
        mean(work.bytes) / 1e6,
        mean(work.cells) / 1e6
    );
    let parts = work.seconds(&machine, flops).map(|s| 1e3 * mean(s));
    let (floor, median) = (parts.iter().sum::<f64>(), times[STEPS / 2]);
    println!(
        "floor {floor:.1} ms: networks {:.1}, rows {:.1}, moments {:.1}, cells {:.1}",
        parts[0], parts[1], parts[2], parts[3]
    );
    println!(
        "time {median:.1} ms (least {:.1}): the floor is {:.0} % of it",
        times[0],
        100.0 * floor / median
    );
    println!(
        "of it, on average: placing {:.1}, encoding {:.1}, evaluating both ways {:.1}, updating {:.1}",
        phases[0], phases[1], phases[2], phases[3]
    );
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
