use std::path::Path;

use serde_json::{Value, json};

use super::*;
use crate::eval::truth::tests::frame;
use crate::scene::Aabb;
use glam::DVec3;

const FRAMES: [&str; 2] = ["000004", "000012"];

/// Two test frames of 20 x 10 px; a mug in the upper left 10 x 6 px of the first, and a place to wash that fills it.
fn scene() -> (tempfile::TempDir, Scene, PhraseTruth) {
    let dir = tempfile::tempdir().unwrap();
    let gt = dir.path().join("gt");
    std::fs::create_dir_all(gt.join("instances")).unwrap();
    std::fs::create_dir_all(gt.join("affordances/wash_it")).unwrap();
    let objects = json!({"3": {"name": "mug", "stream": "dynamic", "moves": true},
                         "4": {"name": "pan", "stream": "dynamic", "moves": true}});
    std::fs::write(gt.join("objects.json"), objects.to_string()).unwrap();
    std::fs::write(gt.join("affordances.json"), r#"["wash it"]"#).unwrap();
    let mug = image::GrayImage::from_fn(20, 10, |x, y| image::Luma([if x < 10 && y < 6 { 3 } else { 0 }]));
    mug.save(gt.join("instances/000004.png")).unwrap();
    image::GrayImage::from_pixel(20, 10, image::Luma([255]))
        .save(gt.join("affordances/wash_it/000004.png"))
        .unwrap();
    let frames = FRAMES.map(|stem| Frame { stem: stem.into(), ..frame(20, 10) }).to_vec();
    let scene = Scene {
        root: dir.path().to_owned(),
        frames,
        bounds: Aabb { min: DVec3::ZERO, max: DVec3::ONE },
        depth_unit: 0.001,
        depth_is_ground_truth: true,
        points: vec![],
        warnings: vec![],
    };
    let truth = PhraseTruth::read(&scene).unwrap();
    (dir, scene, truth)
}

fn file(annotations: Value) -> Value {
    let image = |(n, stem): (usize, &str)| json!({"id": n, "file_name": format!("views/{stem}.png"), "width": 20, "height": 10});
    let images: Vec<Value> = FRAMES.into_iter().enumerate().map(image).collect();
    json!({"images": images, "categories": [{"id": 7, "name": "Mug"}, {"id": 8, "name": "pan"}],
           "annotations": annotations})
}

/// What reading a file gives, on the scene.
struct Read {
    found: Result<Detections, DetectionError>,
    scene: Scene,
    truth: PhraseTruth,
    _dir: tempfile::TempDir,
}

fn read(value: &Value) -> Read {
    let (_dir, scene, truth) = scene();
    let path = scene.root.join("owl.json");
    std::fs::write(&path, value.to_string()).unwrap();
    Read { found: Detections::read(&path, &scene, &truth), scene, truth, _dir }
}

fn iou(annotations: Value) -> Option<f64> {
    let read = read(&file(annotations));
    read.found.unwrap().measure(&read.scene, &read.truth, Task::Objects).unwrap().mean()
}

#[test]
fn boxes_are_scored_by_the_rule_of_fields() {
    let mug =
        |bbox: Value, score: f64| json!({"image_id": 0, "category_id": 7, "bbox": bbox, "score": score});
    assert_eq!(iou(json!([mug(json!([0, 0, 10, 6]), 0.9)])), Some(1.0));
    // Centres decide, and what hangs over the edge is cut.
    assert_eq!(iou(json!([mug(json!([-3, -2.5, 13.4, 8.6]), 0.9)])), Some(1.0));
    assert_eq!(iou(json!([mug(json!([5, 0, 10, 6]), 0.9)])), Some(30.0 / 90.0));
    assert_eq!(iou(json!([mug(json!([0, 0, 10, 6]), 0.5)])), Some(0.0), "not above the threshold");
    assert_eq!(iou(json!([mug(json!([0, 0, 10, 6]), 0.2), mug(json!([0, 0, 5, 6]), 0.7)])), Some(0.5));
    assert_eq!(iou(json!([])), Some(0.0), "what was asked and not found counts");
    let certain = json!({"image_id": 0, "category_id": 7, "bbox": [0, 0, 10, 6]});
    assert_eq!(iou(json!([certain])), Some(1.0), "no score is 1");
}

#[test]
fn masks_win_over_boxes_and_run_down_the_columns() {
    let mask = |counts: Value| {
        json!({"image_id": 0, "category_id": 7, "bbox": [0, 0, 20, 10],
               "segmentation": {"size": [10, 20], "counts": counts}})
    };
    let mut runs = vec![0, 6];
    (0..9).for_each(|_| runs.extend([4, 6]));
    runs.push(104);
    assert_eq!(iou(json!([mask(json!(runs))])), Some(1.0));
    let Read { found, truth, .. } = &read(&file(json!([mask(json!(runs))])));
    let found = found.as_ref().unwrap();
    assert!(found.masks && found.name == "owl");
    assert!(found.asks(Task::Objects, truth) && !found.asks(Task::Affordances, truth));
}

/// Strings that pycocotools 2.0 made of the same masks.
#[test]
fn packed_runs_are_those_of_coco() {
    let packed = |text: &str, pixels| Runs::new(&Counts::Packed(text.into()), pixels);
    let small: Vec<usize> = packed("9220002O", 24).unwrap().inside().collect();
    assert_eq!(small, [9, 10, 13, 14, 17, 18, 23]);
    let large = "bh1V2d0000000000000000000hN0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0:0F0\
                 :0F0b100000000000000000000000000000000000000Rd2";
    assert_eq!(packed(large, 9000).unwrap().inside().count(), 3100);
    for (bad, part) in
        [("922000", "cover"), ("9220002P", "cut off"), ("92 0", "character 2"), ("0O", "negative")]
    {
        let error = packed(bad, 24).unwrap_err();
        assert!(error.contains(part), "{bad}: {error}");
    }
}

#[test]
fn mistakes_are_told_with_file_and_place() {
    let fails = |value: Value, parts: &[&str]| {
        let error = read(&value).found.unwrap_err().to_string();
        for part in parts.iter().chain(&["owl.json"]) {
            assert!(error.contains(part), "`{part}` is not in: {error}");
        }
    };
    let changed = |pointer: &str, value: Value| {
        let mut all = file(json!([{"image_id": 0, "category_id": 7, "bbox": [0, 0, 10, 6]}]));
        *all.pointer_mut(pointer).unwrap() = value;
        all
    };
    fails(json!([1, 2]), &["line 1", "as COCO does"]);
    fails(changed("/images/1/file_name", json!("000013.png")), &["images[1] (000013.png)", "no test frame"]);
    fails(changed("/images/1/width", json!(40)), &["images[1]", "40 x 10 px, the frame 20 x 10"]);
    fails(changed("/images/1/id", json!(0)), &["images[1]", "id 0", "twice"]);
    fails(
        changed("/images", json!([{"id": 0, "file_name": "000004", "width": 20, "height": 10}])),
        &["000012 is missing"],
    );
    fails(changed("/categories/0/name", json!("cup")), &["categories[0] (cup)", "it has mug, pan, wash it"]);
    fails(changed("/categories", json!([{"id": 7, "name": "mug"}])), &["\"pan\" is missing"]);
    fails(changed("/categories/1/id", json!(7)), &["categories[1]", "twice"]);
    fails(changed("/categories", json!([])), &["there are none"]);
    fails(changed("/annotations/0/image_id", json!(9)), &["annotations[0]", "image_id 9"]);
    fails(changed("/annotations/0/category_id", json!(9)), &["annotations[0]", "category_id 9"]);
    fails(
        changed("/annotations/0/bbox", json!([20, 0, 5, 5])),
        &["annotations[0]", "outside the 20 x 10 px"],
    );
    fails(changed("/annotations/0/bbox", json!([5, 5, -2, 4])), &["outside"]);
    fails(changed("/annotations/0/bbox", json!(null)), &["neither"]);
    let with = |key: &str, value: Value| {
        let mut annotation = json!({"image_id": 0, "category_id": 7, "bbox": [0, 0, 10, 6]});
        annotation[key] = value;
        file(json!([annotation]))
    };
    fails(with("score", json!(1.5)), &["annotations[0]", "score is 1.5"]);
    fails(
        with("segmentation", json!({"size": [20, 10], "counts": [200]})),
        &["10 x 20 px, the frame 20 x 10"],
    );
    fails(
        with("segmentation", json!({"size": [10, 20], "counts": [199]})),
        &["cover 199 pixels and not 200"],
    );
    fails(with("segmentation", json!([[0, 0, 5, 0, 5, 5]])), &["segmentation", "run lengths"]);
    let (_dir, scene, truth) = scene();
    let error = Detections::read(Path::new("nowhere.json"), &scene, &truth).unwrap_err().to_string();
    assert!(error.starts_with("nowhere.json: "), "{error}");
}
