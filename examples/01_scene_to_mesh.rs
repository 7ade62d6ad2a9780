//! From a posed video to meshes that Blender, MeshLab and Open3D open:
//!
//! ```text
//! cargo run --release --example 01_scene_to_mesh -- SCENE OUT
//! ```
//!
//! Without arguments it makes a tiny synthetic kitchen first and trains on it for a minute or two.

use std::error::Error;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use divff::config::{Config, Preset};
use divff::map::{self, Format};
use divff::scene::Scene;
use divff::synth::{SynthOptions, generate};
use divff::train::Trainer;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    if let [scene, out] = &arguments[..] {
        return scene_to_mesh(scene, out, Config::preset(Preset::Standard));
    }
    let folder = std::env::temp_dir().join(format!("divff-example-{}", std::process::id()));
    let scene = folder.join("scene");
    generate(&SynthOptions { frames: 24, width: 96, height: 54, seed: 0 }, &scene)?;
    let quick = "
        train = { steps = 300, rays = 2048, streams = 'static' }
        field.persistent.log2_rows = 14
        map = { points = 10000, depth_rays = 200000 }";
    scene_to_mesh(&scene, &folder, Config::default().overlaid(quick, "the example's settings")?)
}

fn scene_to_mesh(scene: &Path, out: &Path, config: Config) -> Result<(), Box<dyn Error>> {
    let scene = Scene::open(scene)?;
    let mut trainer = Trainer::new(&scene, &config)?;
    trainer.run(out, None, &mut |progress| {
        println!("step {}: {:.1} dB on training rays", progress.step, progress.psnr);
        ControlFlow::Continue(())
    })?;
    let map = map::build(&scene, trainer.trained(), &config, &mut |_| ())?;
    for file in map::write(&map, &out.join("map"), &Format::ALL)?.files {
        println!("{}: {} vertices, {} triangles", file.path, file.vertices, file.faces);
    }
    println!("in {}", out.join("map").display());
    Ok(())
}
