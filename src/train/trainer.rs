//! The training loop.
use glam::Vec3;
use crate::scene::*;
use crate::field::*;
use crate::render::density_grid::DensityGrid;
use crate::render::forward::{Grids, Model};
use crate::render::sampler::Sampling;
use super::loss::LossConfig;
use super::pixels::PixelSet;
use super::step::*;

/// Fresh grids.
pub fn grids(field: &Field, cell: f32) -> Grids {
    let e = field.normalisation.extent;
    let world = |c: f32| DensityGrid::new(e, Vec3::splat(c), 1.0);
    Grids { streams: [world(cell), world(cell * 1.5), DensityGrid::new(Vec3::ONE, Vec3::splat(1.0/32.0), 1.0)], threshold: [0.0, 0.0, 0.0] }
}

/// experiment
pub fn experiment() {
    let arg = |k: &str, d: f32| std::env::var(k).ok().and_then(|v| v.parse().ok()).unwrap_or(d);
    let path = std::env::args().nth(1).unwrap();
    let scene = Scene::open(&path).unwrap();
    let streams = arg("STREAMS", 1.0) as u32;
    let mut cfg = FieldConfig::default();
    cfg.persistent.finest = arg("FINEST", 512.0);
    cfg.persistent.log2_rows = arg("LOG2", 17.0) as u32;
    cfg.persistent.levels = arg("LEVELS", 8.0) as usize;
    cfg.persistent.density_bias = arg("BIAS", 0.0);
    cfg.near = arg("NEAR", 0.015);
    let mut field = Field::new(&cfg, &scene, [true, streams > 1, streams > 1], 1);
    let train: Vec<Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).cloned().collect();
    let test: Vec<Frame> = scene.frames.iter().filter(|f| f.split == Split::Test).cloned().collect();
    let pixels = PixelSet::load(train).unwrap();
    let testpix = PixelSet::load(test.clone()).unwrap();
    let cell = arg("CELL", 1.0/128.0);
    let mut grids = grids(&field, cell);
    let mut opt = Optimiser::new(&field);
    let mut lc = LossConfig::default();
    lc.distortion = arg("DIST", 0.3);
    lc.entropy = arg("ENT", 0.0);
    lc.transient = arg("TRANS", 0.01);
    let steps = arg("STEPS", 1000.0) as u64;
    let n = arg("N", 24.0) as usize;
    let t0 = std::time::Instant::now();
    let (mut evals, mut cands, mut sq) = (0usize, 0usize, 0.0);
    let every = arg("EVERY", 500.0) as u64;
    for step in 1..=steps {
        let f = step as f32 / steps as f32;
        let cos = 0.02 + 0.98 * 0.5 * (1.0 + (std::f32::consts::PI * f).cos());
        let warm = (step as f32 / 50.0).min(1.0);
        let explore = (0.5 * (1.0 - f * 8.0)).max(arg("EXPL", 0.1));
        let plan = StepPlan {
            step, rays: arg("RAYS", 4096.0) as usize,
            sampling: Sampling { count: n, step: cell * arg("STEPC", 1.0), explore, sharpness: arg("SHARP", 1.0) },
            table_rate: arg("LR", 1e-2) * cos * warm, network_rate: arg("LRN", 2e-3) * cos * warm,
            exposure_rate: arg("LRE", 1e-3) * cos * warm,
            pose_rate: if f > 0.1 { arg("LRP", 0.0) * cos } else { 0.0 }, rig_rate: if f > 0.1 { arg("LRR", 0.0) * cos } else {0.0},
            grid_rate: arg("GRATE", 0.05), streams: [true, streams > 1, streams > 1], patch: arg("PATCH", 2.0) as u32,
        };
        let r = opt.step(&mut field, &mut grids, &pixels, &lc, &plan, 1);
        evals += r.evaluations; cands += r.candidates; sq += r.squared;
        if step % every == 0 || step == steps {
            let el = t0.elapsed().as_secs_f64();
            print!("{step} {el:.1}s {:.2}M/s {:.0} rays/s eval/cand {:.2} train {:.2}", evals as f64 / el / 1e6, (step * r.rays as u64) as f64 / el, evals as f64 / cands as f64, -10.0 * (sq / every as f64).log10());
            sq = 0.0;
            let stride = if step == steps { arg("STRIDE", 1.0) as u32 } else { 4 };
            let model = Model::new(&field, &grids, [true; 3]);
            let (mut se, mut cnt) = (0.0f64, 0usize);
            let (mut sep, mut cntp) = (0.0f64, 0usize);
            let mut derr = vec![]; let mut bias = vec![];
            let mut iou = [[0usize; 2]; 3]; let mut ious = [(0.0, 0); 3];
            for (i, fr) in test.iter().enumerate() {
                let mut s = plan.sampling; s.count = arg("NTEST", 48.0) as usize; s.explore = 0.05;
                let im = crate::render::image::render(&model, fr, &s, stride);
                let gt = fr.load_depth(scene.depth_unit).unwrap();
                let sp = scene.root.join("gt/streams").join(format!("{}.png", fr.stem));
                let lab = image::open(&sp).ok().map(|i| i.into_luma8().into_raw());
                for y in 0..im.height { for x in 0..im.width {
                    let k = (y * im.width + x) as usize; let g = (y * stride * fr.camera.width + x * stride) as usize;
                    let mut e = 0.0;
                    for c in 0..3 { let d = im.rgb[k][c] as f64 - testpix.images[i][g][c] as f64 / 255.0; e += d * d / 3.0; }
                    se += e; cnt += 1;
                    if let Some(l) = &lab { 
                        if l[g] == 0 { sep += e; cntp += 1; }
                        let o = im.opacity[k]; let a = if o[1] > o[0] && o[1] >= o[2] {1} else if o[2] > o[0] {2} else {0};
                        for s in 0..3 { if a == s && l[g] as usize == s { iou[s][0] += 1; } if a == s || l[g] as usize == s { iou[s][1] += 1; } }
                    }
                    if let Some(gt) = &gt { if gt[g] > 0.0 { let d = im.depth[k] - gt[g]; derr.push(d.abs()); bias.push(d); } }
                }}
                if let Some(l) = &lab { for s in 0..3 { if l.iter().filter(|v| **v as usize == s).count() >= 50 { ious[s].0 += iou[s][0] as f64 / iou[s][1].max(1) as f64; ious[s].1 += 1; } } }
                iou = [[0; 2]; 3];
                if step == steps && (i == 3 || i == 10 || i == 20) {
                    let mut b = image::RgbImage::new(im.width * 4, im.height);
                    for y in 0..im.height { for x in 0..im.width { let k = (y * im.width + x) as usize; let g = (y * stride * fr.camera.width + x * stride) as usize;
                        b.put_pixel(x, y, image::Rgb(im.rgb[k].map(|c| (c * 255.0) as u8)));
                        b.put_pixel(x + im.width, y, image::Rgb(testpix.images[i][g]));
                        let d = (im.depth[k] / 5.0 * 255.0) as u8; b.put_pixel(x + 2 * im.width, y, image::Rgb([d, d, if d == 0 {100} else {d}]));
                        b.put_pixel(x + 3 * im.width, y, image::Rgb(im.opacity[k].map(|c| (c * 255.0) as u8)));
                    }}
                    b.save(format!("{}_{}.png", std::env::var("OUT").unwrap_or("/work/tmp/exp".into()), i)).unwrap();
                }
            }
            derr.sort_by(f32::total_cmp); bias.sort_by(f32::total_cmp);
            let m = |v: &Vec<f32>| if v.is_empty() { 0.0 } else { v[v.len() / 2] };
            let w5 = derr.iter().filter(|d| **d < 0.05).count() as f32 / derr.len().max(1) as f32;
            println!(" | test {:.2} pers {:.2} depth med {:.3} bias {:.3} <5cm {:.2} iou {:.2} {:.2} {:.2}", -10.0 * (se / cnt as f64).log10(), -10.0 * (sep / cntp.max(1) as f64).log10(), m(&derr), m(&bias), w5,
              ious[0].0 / ious[0].1 as f64, ious[1].0 / ious[1].1 as f64, ious[2].0 / ious[2].1 as f64);
        }
    }
    let rig = &field.weights[field.layout.rig.clone()];
    println!("rig {rig:?} scale {}", field.normalisation.scale);
    println!("total {:.1}s", t0.elapsed().as_secs_f64());
}
