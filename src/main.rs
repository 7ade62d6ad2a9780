//! tmp
use std::ops::ControlFlow;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let scene = divff::scene::Scene::open(&a[1]).unwrap();
    let mut cfg = divff::config::Config::default();
    for s in &a[3..] {
        cfg = cfg.overlaid(s, s).unwrap();
    }
    let run = std::path::PathBuf::from(&a[2]);
    let mut t = divff::train::Trainer::new(&scene, &cfg).unwrap();
    let r = t
        .run(&run, None, &mut |p| {
            if p.step % 500 == 0 || p.fraction >= 1.0 {
                println!("{p:?}");
            }
            ControlFlow::Continue(())
        })
        .unwrap();
    println!("{r:?}");
}
