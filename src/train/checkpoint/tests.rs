//! Checkpoints: what is saved is what is loaded, and what is damaged is refused.

use super::*;
use crate::rng::Rng;
use crate::train::testing;

const CELLS: f32 = 8.0;

/// A field, grids and optimiser full of random numbers.
fn random(seed: u64) -> (Trained, Optimiser) {
    let config = testing::config();
    let mut field = Field::zeros(testing::shape(&config));
    field.init(seed);
    let mut rng = Rng::new(seed, 1, 0);
    let mut fill = |_: String, into: &mut [f32]| {
        into.fill_with(|| 2.0 * rng.uniform() - 1.0);
        Ok(())
    };
    let mut grids = Grids::new(&field, CELLS);
    grids.threshold = [0.1, 0.2, 0.3];
    let mut optimiser = Optimiser::new(&field);
    optimiser.visit_mut(&mut fill).expect("filling cannot fail");
    let progress = TrainingState {
        step: 12,
        seconds: 0.1,
        finished: false,
        evaluations: 3,
        faint: 2,
        candidates: 4,
        absent: 6,
        spared: 7,
        unrefined: 8,
        unseen: 9,
        rays: 5,
        streams_settled: true,
        unexplained: Some(0.125),
        aligned: 2,
        joint: 0,
        prepared: 0.5,
        trusts_poses: true,
        given_coverage: Some(0.25),
        judged: Some(12),
        stereo_left_out: Some(0.75),
        stereo_from: Some((0..field.layout.refinement().len()).map(|n| 1.5e-3 * n as f32).collect()),
    };
    let mut trained = Trained { field, grids, progress };
    trained.visit_mut(&mut fill).expect("filling cannot fail");
    (trained, optimiser)
}

fn saved(trained: &Trained, optimiser: Option<&Optimiser>) -> tempfile::TempDir {
    let run = tempfile::tempdir().expect("a temporary folder");
    trained.save(run.path(), CELLS, optimiser).expect("the temporary folder can be written");
    run
}

#[test]
fn save_and_load_give_back_every_bit() {
    let (trained, optimiser) = random(1);
    let run = saved(&trained, Some(&optimiser));
    let (back, back_optimiser) = Trained::resume(run.path()).expect("it was just written");
    let mut before = Vec::new();
    trained.visit(|name, v| before.push((name, bits(v))));
    optimiser.visit(|name, v| before.push((name, bits(v))));
    let mut after = Vec::new();
    back.visit(|name, v| after.push((name, bits(v))));
    back_optimiser.visit(|name, v| after.push((name, bits(v))));
    assert!(before == after);
    assert_eq!(back.progress, trained.progress);
    assert_eq!(back.field.shape, trained.field.shape);
    assert_eq!(back.grids.threshold, trained.grids.threshold);
    let again = saved(&back, Some(&back_optimiser));
    let file =
        |run: &tempfile::TempDir| std::fs::read(Trained::path(run.path())).expect("it was just written");
    assert!(file(&run) == file(&again), "saving again gives other bytes");
}

fn bits(v: &[f32]) -> Vec<u32> {
    v.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn every_truncation_is_refused() {
    let (trained, _) = random(2);
    let run = saved(&trained, None);
    let path = Trained::path(run.path());
    let bytes = std::fs::read(&path).expect("it was just written");
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as usize;
    // Every length through the header, the first and the last numbers, and some in between, shortest last.
    let lengths = (0..bytes.len())
        .rev()
        .filter(|n| *n < header + 64 || *n + 64 > bytes.len() || n % (bytes.len() / 64) == 0);
    let file = std::fs::OpenOptions::new().write(true).open(&path).expect("it was just written");
    for n in lengths {
        file.set_len(n as u64).expect("a file can be cut");
        assert!(
            matches!(Trained::load(run.path()), Err(TrainError::Checkpoint(_))),
            "{n} of {} bytes were taken for a checkpoint",
            bytes.len()
        );
    }
}

#[test]
fn a_checkpoint_with_a_number_that_is_not_finite_is_refused() {
    let (mut trained, _) = random(3);
    trained.field.weights[5] = f32::NAN;
    let run = saved(&trained, None);
    let error = Trained::load(run.path()).expect_err("NaN").to_string();
    assert!(error.contains("weights[5]"), "{error}");
}

#[test]
fn a_field_without_optimiser_can_be_used_but_not_resumed() {
    let (trained, _) = random(4);
    let run = saved(&trained, None);
    assert!(Trained::load(run.path()).is_ok());
    assert!(matches!(Trained::resume(run.path()), Err(TrainError::Checkpoint(_))));
}

/// Replaces text in the header by text of the same length.
fn tamper(run: &tempfile::TempDir, from: &str, to: &str) {
    assert_eq!(from.len(), to.len());
    let path = Trained::path(run.path());
    let mut bytes = std::fs::read(&path).expect("it was just written");
    let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).expect("the text is in the header");
    bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
    std::fs::write(&path, bytes).expect("the temporary folder can be written");
}

#[test]
fn a_header_that_asks_for_more_than_the_file_holds_is_refused() {
    for (from, to) in [
        (r#"log2_rows\":9"#, r#"log2_rows\":3"#),
        (r#"\"levels\":3"#, r#"\"levels\":9"#),
        (r#"\"levels\":3"#, r#"\"levels\":0"#),
        (r#"log2_rows\":9,\"hidden\":10"#, r#"log2_rows\":62,\"hidden\":4"#),
        (r#"\"hidden\":10"#, r#"\"hidden\":99"#),
        (r#"\"finest\":20.0"#, r#"\"finest\":9e37"#),
        (r#"grid_cells\":8.0"#, r#"grid_cells\":9e9"#),
        (r#"grid_cells\":8.0"#, r#"grid_cells\":0.0"#),
        (r#"\"format\":1"#, r#"\"format\":7"#),
        (r#"\"times\":[0.0,0.5,1.0]"#, r#"\"times\":[           ]"#),
    ] {
        let (trained, _) = random(5);
        let run = saved(&trained, None);
        tamper(&run, from, to);
        let loaded = Trained::load(run.path());
        assert!(
            matches!(loaded, Err(TrainError::Checkpoint(_) | TrainError::Config(_))),
            "{to} was taken for a checkpoint"
        );
    }
}
