//! Small fields and frames that the tests of rendering and of maps share.

use glam::{DAffine3, DMat3, DVec3};

use crate::field::{Field, FieldConfig, FieldShape, Normalisation, StreamConfig};
use crate::scene::{Aabb, Camera, Frame, Split};

/// A small untrained field with random weights, in a box of two world units at (10, 20, 30).
pub(crate) fn field(streams: [bool; 3]) -> Field {
    field_at(streams, DVec3::new(10.0, 20.0, 30.0))
}

/// As [`field`], with the box's smallest corner at `origin`.
pub(crate) fn field_at(streams: [bool; 3], origin: DVec3) -> Field {
    let small = StreamConfig {
        levels: 3,
        coarsest: 4.0,
        finest: 16.0,
        log2_rows: 10,
        hidden: 8,
        layers: 1,
        code: 0,
        knots: 0,
        time_levels: 0,
        time_finest: 16.0,
        time_cells: 0.5,
        density_bias: -2.0,
    };
    let moving = StreamConfig { code: 4, knots: 4, time_levels: 2, ..small.clone() };
    let config =
        FieldConfig { persistent: small, dynamic: moving.clone(), actor: moving, ..FieldConfig::default() };
    let mut field = Field::zeros(FieldShape {
        config,
        normalisation: Normalisation::new(Aabb { min: origin, max: origin + 2.0 }),
        streams,
        times: vec![0.0, 0.5, 1.0],
        background: [0.5; 3],
    });
    field.init(7);
    field
}

/// A frame that looks along +y into the box of [`field`].
pub(crate) fn frame(time: f64) -> Frame {
    frame_at(time, DVec3::new(10.0, 20.0, 30.0))
}

/// As [`frame`], for [`field_at`].
pub(crate) fn frame_at(time: f64, origin: DVec3) -> Frame {
    // Camera x is world x, camera y is world −z, camera z is world y: upright in a Z-up world.
    let axes = DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y);
    Frame {
        stem: format!("{:06}", (time * 100.0) as u32),
        image_path: "none.png".into(),
        camera: Camera { width: 16, height: 12, fx: 10.0, fy: 10.0, cx: 8.0, cy: 6.0, distortion: [0.0; 4] },
        c2w: DAffine3 { matrix3: axes, translation: origin + DVec3::new(0.9 + 0.2 * time, 0.1, 1.0) },
        time,
        frame_index: (time * 100.0) as u32,
        split: Split::Train,
        depth_path: None,
        mask_path: None,
    }
}
