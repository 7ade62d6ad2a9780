//! What happens: where the head goes and looks, which objects are carried where, what the hands do
//! meanwhile.
//!
//! Time runs over [0, 1] whatever the number of frames, so that more frames show the same story in finer
//! steps.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Quat, Vec3};

use super::arms::Hand;
use super::noise::Rng;
use super::props::Prop;
use super::room::{Place, Room};

/// Where the hands are when they do nothing, camera coordinates of the right one.
const HAND_AT_REST: Vec3 = Vec3::new(0.17, 0.215, 0.44);
/// Where the object's grip is while it is carried, camera coordinates.
const CARRY: Vec3 = Vec3::new(0.09, 0.19, 0.50);
/// Fingertips to palm, m.
const REACH: f32 = 0.06;
/// Places that not everything fits: the sink (no long things), the hob (what may get hot).
const SINK: usize = 1;
const HOB: usize = 2;

/// A camera pose: position, heading about z and elevation (rad).
#[derive(Clone, Copy, Debug)]
pub(super) struct Head {
    pub at: Vec3,
    pub yaw: f32,
    pub pitch: f32,
}

/// One object carried from a place to another. Times in [0, 1]: lifted `grab…lifted`, put down
/// `lower…release`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Move {
    pub prop: usize,
    from: usize,
    to: usize,
    pub grab: f32,
    lifted: f32,
    lower: f32,
    pub release: f32,
}

/// The whole story of a seed.
pub(super) struct Story {
    keys: Vec<(f32, Head)>,
    pub moves: Vec<Move>,
    /// Place of each prop before the first move.
    start: Vec<usize>,
    /// Heading of each prop at each place, `[props][places]`.
    headings: Vec<Vec<f32>>,
    /// Length of one beat: what a walk between two places takes.
    beat: f32,
}

impl Head {
    fn looking(at: Vec3, target: Vec3, previous: Option<Self>) -> Self {
        let d = target - at;
        let mut yaw = d.y.atan2(d.x);
        if let Some(previous) = previous {
            // The shorter way round.
            yaw += ((previous.yaw - yaw) / TAU).round() * TAU;
        }
        Self { at, yaw, pitch: d.z.atan2(d.truncate().length()).clamp(-1.0, 0.55) }
    }

    fn lerp(self, other: Self, w: f32) -> Self {
        Self {
            at: self.at.lerp(other.at, w),
            yaw: self.yaw + (other.yaw - self.yaw) * w,
            pitch: self.pitch + (other.pitch - self.pitch) * w,
        }
    }

    /// Camera axes (right, down, forward) and position: OpenCV's camera to world.
    pub(super) fn camera_to_world(self) -> Affine3A {
        let (sy, cy) = self.yaw.sin_cos();
        let (sp, cp) = self.pitch.sin_cos();
        let forward = Vec3::new(cp * cy, cp * sy, sp);
        let right = Vec3::new(sy, -cy, 0.0);
        Affine3A::from_mat3_translation(glam::Mat3::from_cols(right, forward.cross(right), forward), self.at)
    }
}

impl Story {
    /// Plans `count` moves.
    pub(super) fn new(room: &Room, props: &[Prop], count: usize, seed: u64) -> Self {
        let mut rng = Rng::new(seed ^ 0x73_74_6f_72_79);
        let headings = props
            .iter()
            .map(|p| room.places.iter().map(|place| heading(p, place, &mut rng)).collect())
            .collect();
        let mut start = vec![8, HOB, 0, 3, 6, 5];
        for _ in 0..4 {
            // Nobody sees these: they make the kitchens of two seeds start differently.
            if let Some((prop, to)) = choose(&room.places, &start, &[], &mut rng) {
                start[prop] = to;
            }
        }
        let mut story = Self { keys: vec![], moves: vec![], start: start.clone(), headings, beat: 1.0 };
        story.plan(room, start, count, &mut rng);
        story
    }

    fn plan(&mut self, room: &Room, mut at: Vec<usize>, count: usize, rng: &mut Rng) {
        let mut now = 0.0;
        let first = rng.below(room.sights.len());
        let mut sights = (0..).map(|i| room.sights[(first + i) % room.sights.len()]);
        for sight in sights.by_ref().take(3) {
            self.look(now, sight.head, sight.at);
            now += 1.0;
        }
        let mut moved = Vec::new();
        for sight in sights.take(count) {
            self.look(now, sight.head, sight.at);
            if moved.len() >= at.len() - 2 {
                moved.remove(0);
            }
            let Some((prop, to)) = choose(&room.places, &at, &moved, rng) else { continue };
            let (from, target) = (room.places[at[prop]], room.places[to]);
            let grab = now + 1.2;
            self.look(grab, from.head, from.at);
            self.look(grab + 0.5, from.head, from.at);
            let lower = grab + 1.9;
            self.look(lower, target.head, target.at);
            self.look(lower + 0.5, target.head, target.at);
            self.moves.push(Move {
                prop,
                from: at[prop],
                to,
                grab,
                lifted: grab + 0.5,
                lower,
                release: lower + 0.5,
            });
            at[prop] = to;
            moved.push(prop);
            now = lower + 1.6;
        }
        self.rescale(now - 0.6);
    }

    fn look(&mut self, time: f32, head: Vec3, target: Vec3) {
        let previous = self.keys.last().map(|k| k.1);
        self.keys.push((time, Head::looking(head, target, previous)));
    }

    /// Maps the plan's own time, 0…`end`, to 0…1.
    fn rescale(&mut self, end: f32) {
        self.beat = 1.0 / end;
        for key in &mut self.keys {
            key.0 /= end;
        }
        for m in &mut self.moves {
            for t in [&mut m.grab, &mut m.lifted, &mut m.lower, &mut m.release] {
                *t /= end;
            }
        }
    }

    /// Head pose: the keys joined by straight lines, rounded by a running mean, with a walker's bob.
    pub(super) fn head(&self, time: f32) -> Head {
        const TAPS: i32 = 8;
        let width = 0.45 * self.beat;
        let mut sum = self.keyed(time);
        let mut weights = 1.0;
        for i in -TAPS..=TAPS {
            if i == 0 {
                continue;
            }
            let x = i as f32 / (TAPS + 1) as f32;
            let weight = 1.0 - x * x;
            weights += weight;
            sum = sum.lerp(self.keyed(time + x * width), weight / weights);
        }
        let phase = TAU * time / self.beat;
        sum.at.z += 0.012 * (1.7 * phase).sin();
        sum.yaw += 0.03 * (0.63 * phase).sin();
        sum.pitch += 0.02 * (0.91 * phase + 1.0).sin();
        sum
    }

    fn keyed(&self, time: f32) -> Head {
        let next = self.keys.partition_point(|k| k.0 <= time);
        if next == 0 {
            return self.keys[0].1;
        }
        let Some(&(t1, b)) = self.keys.get(next) else { return self.keys[next - 1].1 };
        let (t0, a) = self.keys[next - 1];
        a.lerp(b, (time - t0) / (t1 - t0))
    }

    /// Object to world of a prop.
    pub(super) fn prop_pose(&self, room: &Room, props: &[Prop], prop: usize, time: f32) -> Affine3A {
        let rest = |place: usize| (room.places[place].at, self.headings[prop][place]);
        let last = self.moves.iter().rfind(|m| m.prop == prop && m.grab < time);
        let (at, yaw) = match last {
            None => rest(self.start[prop]),
            Some(m) if time >= m.release => rest(m.to),
            Some(m) => {
                let head = self.head(time);
                let grip = props[prop].grip;
                let yaw = head.yaw + PI - grip.y.atan2(grip.x);
                let hand = head.camera_to_world().transform_point3(CARRY);
                let carried = (hand - Quat::from_rotation_z(yaw) * grip, yaw);
                if time < m.lifted {
                    blend(rest(m.from), carried, (time - m.grab) / (m.lifted - m.grab))
                } else if time > m.lower {
                    blend(carried, rest(m.to), (time - m.lower) / (m.release - m.lower))
                } else {
                    carried
                }
            }
        };
        Affine3A::from_rotation_translation(Quat::from_rotation_z(yaw), at)
    }

    /// The object in the hand at a time.
    pub(super) fn carried(&self, time: f32) -> Option<usize> {
        self.moves.iter().find(|m| m.grab < time && time < m.release).map(|m| m.prop)
    }

    /// Left and right hand: they hang at the lower edge of the view, the right one reaches for what is
    /// carried.
    pub(super) fn hands(&self, room: &Room, props: &[Prop], time: f32) -> [Hand; 2] {
        let phase = TAU * time / self.beat;
        let sway =
            Vec3::new(0.012 * (1.3 * phase).sin(), 0.012 * (1.7 * phase).cos(), 0.015 * (0.8 * phase).sin());
        let mirrored = HAND_AT_REST * Vec3::new(-1.0, 1.0, 1.0);
        let left = Hand { palm: mirrored + sway * Vec3::new(1.0, -0.7, 1.0), grip: 0.2 };
        let mut right = Hand { palm: HAND_AT_REST + sway, grip: 0.2 };
        let reach_time = 0.5 * self.beat;
        for m in &self.moves {
            let into = ((time - m.grab + reach_time) / reach_time).clamp(0.0, 1.0);
            let out = ((m.release + reach_time - time) / reach_time).clamp(0.0, 1.0);
            let weight = smooth(into.min(out));
            if weight > 0.0 {
                let world = self.prop_pose(room, props, m.prop, time).transform_point3(props[m.prop].grip);
                let grip = self.head(time).camera_to_world().inverse().transform_point3(world);
                let palm = grip - grip.normalize_or(Vec3::Z) * REACH - Vec3::Y * 0.02;
                right = Hand { palm: right.palm.lerp(palm, weight), grip: 0.2 + 0.8 * weight };
            }
        }
        [left, right]
    }
}

fn smooth(w: f32) -> f32 {
    let w = w.clamp(0.0, 1.0);
    w * w * (3.0 - 2.0 * w)
}

/// Between two poses (position, heading), eased.
fn blend(a: (Vec3, f32), b: (Vec3, f32), w: f32) -> (Vec3, f32) {
    let w = smooth(w);
    let turn = b.1 - a.1 - ((b.1 - a.1) / TAU).round() * TAU;
    (a.0.lerp(b.0, w), a.1 + turn * w)
}

/// Heading at which a prop's handle points at whoever stands at the place, give or take.
fn heading(prop: &Prop, place: &Place, rng: &mut Rng) -> f32 {
    let to_head = (place.head - place.at).truncate();
    let handle = prop.grip.truncate();
    let aim =
        if handle.length() > 0.02 { to_head.y.atan2(to_head.x) - handle.y.atan2(handle.x) } else { 0.0 };
    aim + rng.range(-0.3, 0.3)
}

/// A prop that is not in `not_these` and a free place for it, at least half a metre away.
fn choose(places: &[Place], at: &[usize], not_these: &[usize], rng: &mut Rng) -> Option<(usize, usize)> {
    const PAN: usize = 1;
    const BOARD: usize = 2;
    const KETTLE: usize = 5;
    let fits = |prop: usize, place: usize| match place {
        SINK => ![PAN, BOARD, KETTLE].contains(&prop),
        HOB => [PAN, KETTLE].contains(&prop),
        _ => true,
    };
    let candidates: Vec<_> = (0..at.len())
        .filter(|prop| !not_these.contains(prop))
        .flat_map(|prop| (0..places.len()).map(move |place| (prop, place)))
        .filter(|&(prop, place)| {
            !at.contains(&place) && fits(prop, place) && places[at[prop]].at.distance(places[place].at) > 0.5
        })
        .collect();
    (!candidates.is_empty()).then(|| candidates[rng.below(candidates.len())])
}
