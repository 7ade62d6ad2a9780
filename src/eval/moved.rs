//! Whether what was moved is found where it is at that time, and not where it is at other times.

use glam::{DVec2, DVec3};
use serde_json::Value;

use super::scores::{MIN_PIXELS, PhraseTruth, THRESHOLD, json, labels, wrong};
use super::{EvalError, Metrics};
use crate::scene::features::Space;
use crate::scene::{Frame, Pose, Scene, Split};

/// A place is another one if an object's origin is farther away there, world units.
const APART: f64 = 0.1;

/// Something is in front of a place if it is nearer than the place by this share of its depth. Depth is that of pixel
/// centres, so a slanted surface differs by a little within a pixel.
const IN_FRONT: f64 = 0.02;

/// Points that stand for an object's surface, at most.
const POINTS: usize = 20_000;

const TIMELINE: &str =
    "an object with `moves` (object, frames) and `object_to_world` (3 × 4 matrices of each frame)";

/// An object that moves.
#[derive(Clone, Debug, PartialEq)]
struct Moving {
    number: u32,
    phrase: String,
    /// Object to world, of every frame of the video.
    poses: Vec<Pose>,
    /// Where it rests: a frame of each stay.
    stays: Vec<usize>,
    /// Places on its surface, object coordinates.
    points: Vec<DVec3>,
}

/// The objects that move, and how often each was found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MovedObjects {
    objects: Vec<Moving>,
    found: Vec<bool>,
}

impl MovedObjects {
    /// Reads `gt/timeline.json`; the objects' surfaces are what the true depth of the test frames shows of them.
    ///
    /// Nothing moves where the scene has no such file, no depth or no instances.
    ///
    /// # Errors
    /// Truth that cannot be read, or is not what it should be.
    pub fn read(scene: &Scene, truth: &PhraseTruth) -> Result<Self, EvalError> {
        let Some((path, timeline)) = json(&truth.root.join("timeline.json"))? else {
            return Ok(Self::default());
        };
        let mut objects = Vec::new();
        for (number, phrase) in &truth.objects {
            objects.extend(moving(&timeline, *number, phrase).ok_or_else(|| wrong(&path, TIMELINE))?);
        }
        for frame in scene.frames.iter().filter(|f| f.split == Split::Test) {
            let Some((instances, depth)) = seen(scene, truth, frame)? else { continue };
            for object in &mut objects {
                object.add_points(frame, &instances, &depth);
            }
        }
        for object in &mut objects {
            let every = object.points.len().div_ceil(POINTS).max(1);
            object.points = object.points.iter().step_by(every).copied().collect();
        }
        Ok(Self { objects, found: Vec::new() })
    }

    /// Looks for the objects in a frame's scores, `(space, phrase, [height * width])`.
    ///
    /// # Errors
    /// Truth that cannot be read, or of another size than the frame.
    pub fn add(
        &mut self,
        scene: &Scene,
        truth: &PhraseTruth,
        frame: &Frame,
        scores: &[(Space, String, Vec<f32>)],
    ) -> Result<(), EvalError> {
        if self.objects.is_empty() {
            return Ok(());
        }
        let Some((instances, depth)) = seen(scene, truth, frame)? else { return Ok(()) };
        for object in &self.objects {
            let of_phrase = |s: &&(Space, String, Vec<f32>)| s.0 == Space::Clip && s.1 == object.phrase;
            let Some((.., scores)) = scores.iter().find(of_phrase) else { continue };
            // Another thing of that name is rightly found wherever it is.
            let alike: Vec<u32> =
                self.objects.iter().filter(|o| o.phrase == object.phrase).map(|o| o.number).collect();
            let here = mean(scores, |n| instances[n] == object.number);
            let elsewhere: Vec<f64> = object
                .other_places(frame, &depth)
                .into_iter()
                .filter_map(|place| mean(scores, |n| place[n] && !alike.contains(&instances[n])))
                .collect();
            self.found.extend(verdict(here, &elsewhere));
        }
        Ok(())
    }

    /// Fills in `moved_objects_found` and `moved_objects_scored`, or why they are absent.
    pub fn fill_in(&self, metrics: &mut Metrics) {
        let count = self.found.len();
        if count == 0 {
            let why = "no test frame shows the place of an object that moves and has a score";
            metrics.absent.insert("moved_objects_found".into(), why.into());
            return;
        }
        let found = self.found.iter().filter(|f| **f).count();
        metrics.moved_objects_found = Some(found as f64 / count as f64);
        metrics.moved_objects_scored = Some(count);
    }
}

/// Whether an object is where it is and nowhere else; `None` if a frame shows none of its places.
///
/// `here`: mean score where it is, if it is seen. `elsewhere`: those of its other places that are seen.
fn verdict(here: Option<f64>, elsewhere: &[f64]) -> Option<bool> {
    let threshold = f64::from(THRESHOLD);
    if here.is_none() && elsewhere.is_empty() {
        return None;
    }
    let is_here = here.is_none_or(|score| score > threshold);
    let most = here.unwrap_or(threshold).min(threshold);
    Some(is_here && elsewhere.iter().all(|score| *score <= most))
}

/// Mean score of the pixels inside; `None` if they are too few.
fn mean(scores: &[f32], inside: impl Fn(usize) -> bool) -> Option<f64> {
    let chosen = scores.iter().enumerate().filter(|(n, _)| inside(*n));
    let (sum, count) = chosen.fold((0.0, 0usize), |(sum, count), (_, s)| (sum + f64::from(*s), count + 1));
    (count >= MIN_PIXELS).then(|| sum / count as f64)
}

/// Instance and depth of every pixel.
type Seen = (Vec<u32>, Vec<f32>);

/// True instances and depth of a frame; `None` if either is missing.
fn seen(scene: &Scene, truth: &PhraseTruth, frame: &Frame) -> Result<Option<Seen>, EvalError> {
    let path = truth.root.join("instances").join(format!("{}.png", frame.stem));
    let Some(instances) = labels(&path, frame)? else { return Ok(None) };
    Ok(frame.load_depth(scene.depth_unit)?.map(|depth| (instances, depth)))
}

/// What a timeline says of an object: `Some(None)` if it does not move, `None` if the timeline makes no sense.
fn moving(timeline: &Value, number: u32, phrase: &str) -> Option<Option<Moving>> {
    let mut stays = Vec::new();
    for one in timeline.get("moves")?.as_array()? {
        if one.get("object")?.as_u64()? != u64::from(number) {
            continue;
        }
        let [first, last] = one.get("frames")?.as_array()?.as_slice() else { return None };
        stays.push((first.as_u64()? as usize).saturating_sub(1));
        stays.push(last.as_u64()? as usize + 1);
    }
    let Some(poses) = timeline.get("object_to_world")?.get(number.to_string()) else { return Some(None) };
    let poses: Vec<Pose> = poses.as_array()?.iter().map(pose).collect::<Option<_>>()?;
    stays.retain(|n| *n < poses.len());
    stays.dedup();
    if stays.is_empty() {
        return Some(None);
    }
    Some(Some(Moving { number, phrase: phrase.to_owned(), poses, stays, points: Vec::new() }))
}

/// A 3 × 4 matrix, row by row, as twelve numbers or as rows of four.
fn pose(value: &Value) -> Option<Pose> {
    let flat = |v: &Value| v.as_array().cloned().unwrap_or_else(|| vec![v.clone()]);
    let numbers: Vec<f64> =
        value.as_array()?.iter().flat_map(flat).map(|v| v.as_f64()).collect::<Option<_>>()?;
    let rows: [f64; 12] = numbers.get(..12)?.try_into().ok()?;
    let column = |c: usize| DVec3::new(rows[c], rows[4 + c], rows[8 + c]);
    let pose = Pose::from_cols(column(0), column(1), column(2), column(3));
    (pose.is_finite() && pose.matrix3.determinant().abs() > 1e-12).then_some(pose)
}

impl Moving {
    /// Adds what a frame shows of the object.
    fn add_points(&mut self, frame: &Frame, instances: &[u32], depth: &[f32]) {
        let Some(pose) = self.poses.get(frame.frame_index as usize) else { return };
        let from_camera = pose.inverse() * frame.c2w;
        let width = frame.camera.width as usize;
        for (n, z) in depth.iter().enumerate() {
            if instances[n] == self.number && *z > 0.0 {
                let direction =
                    frame.camera.unproject(DVec2::new((n % width) as f64, (n / width) as f64) + 0.5);
                self.points.push(from_camera.transform_point3(direction * (f64::from(*z) / direction.z)));
            }
        }
    }

    /// For each stay at another place than now: the pixels where the object would be seen, nothing being in front.
    fn other_places(&self, frame: &Frame, depth: &[f32]) -> Vec<Vec<bool>> {
        let Some(now) = self.poses.get(frame.frame_index as usize) else { return Vec::new() };
        let mut places: Vec<DVec3> = vec![now.translation];
        let mut found = Vec::new();
        for stay in &self.stays {
            let pose = &self.poses[*stay];
            if places.iter().all(|p| p.distance(pose.translation) > APART) {
                places.push(pose.translation);
                found.push(self.pixels_at(pose, frame, depth));
            }
        }
        found
    }

    fn pixels_at(&self, pose: &Pose, frame: &Frame, depth: &[f32]) -> Vec<bool> {
        let to_camera = frame.c2w.inverse() * *pose;
        let (width, height) = (frame.camera.width, frame.camera.height);
        let mut inside = vec![false; depth.len()];
        for point in &self.points {
            let p = to_camera.transform_point3(*point);
            let Some(uv) = frame.camera.project(p).filter(|_| p.z > 0.0) else { continue };
            if !(uv.x >= 0.0 && uv.y >= 0.0 && uv.x < f64::from(width) && uv.y < f64::from(height)) {
                continue;
            }
            let n = uv.y as usize * width as usize + uv.x as usize;
            let z = f64::from(depth[n]);
            inside[n] |= z > 0.0 && z > p.z * (1.0 - IN_FRONT);
        }
        inside
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::truth::tests::frame;

    #[test]
    fn an_object_is_found_where_it_is_and_not_where_it_was() {
        assert_eq!(verdict(None, &[]), None);
        assert_eq!(verdict(Some(0.7), &[]), Some(true));
        assert_eq!(verdict(Some(0.7), &[0.4]), Some(true));
        assert_eq!(verdict(None, &[0.4]), Some(true));
        // Not here; still there; there as well; more there than here.
        assert_eq!(verdict(Some(0.5), &[]), Some(false));
        assert_eq!(verdict(None, &[0.6]), Some(false));
        assert_eq!(verdict(Some(0.7), &[0.4, 0.6]), Some(false));
        assert_eq!(verdict(Some(0.3), &[0.4]), Some(false));
    }

    #[test]
    fn the_former_place_is_where_the_object_projects_to_unless_something_is_in_front() {
        let poses = [0.0, 0.0, 0.5, 1.0, 1.0]
            .map(|x| [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]]);
        let timeline = serde_json::json!({
            "moves": [{"object": 3, "frames": [2, 3]}],
            "object_to_world": {"3": poses},
        });
        let mut object = moving(&timeline, 3, "mug").unwrap().unwrap();
        assert_eq!(object.stays, [1, 4]);
        assert_eq!(moving(&timeline, 4, "pan"), Some(None));
        // Frame 4: the object, two pixels, is at x = 1, a wall behind everything.
        let f = frame(20, 10);
        let mut instances = vec![0; 200];
        let at = |x: usize| 5 * 20 + x;
        // f = 10 px: one unit at depth 2 is five pixels.
        (instances[at(15)], instances[at(16)]) = (3, 3);
        let mut depth = vec![4.0; 200];
        (depth[at(15)], depth[at(16)]) = (2.0, 2.0);
        object.add_points(&f, &instances, &depth);
        let pixels = |depth: &[f32]| -> Vec<usize> {
            let places = object.other_places(&f, depth);
            assert_eq!(places.len(), 1);
            (0..200).filter(|n| places[0][*n]).collect()
        };
        assert_eq!(pixels(&depth), [at(10), at(11)]);
        depth[at(10)] = 1.0;
        assert_eq!(pixels(&depth), [at(11)]);
    }

    #[test]
    fn a_timeline_that_makes_no_sense_is_refused() {
        let bad = |text: &str| moving(&serde_json::from_str(text).unwrap(), 3, "mug").is_none();
        assert!(bad("{}") && bad(r#"{"moves": [{"object": 3, "frames": [1]}], "object_to_world": {}}"#));
        assert!(bad(r#"{"moves": [], "object_to_world": {"3": [[1, 2]]}}"#));
    }
}
