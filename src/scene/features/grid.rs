//! Descriptors on a grid over the image: overlapping patches, and cells.

use super::table::Descriptors;

/// A few rows of a table and how much each counts; the weights sum to 1.
///
/// Fixed size, so that a trainer can keep one per ray without allocating.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blend {
    rows: [u32; Self::MAX],
    weights: [f32; Self::MAX],
    len: u8,
}

impl Blend {
    /// Most rows in a blend: four neighbours on each of four scales, or the levels of a mask.
    pub const MAX: usize = 16;

    /// One row that counts alone.
    pub fn one(row: u32) -> Self {
        let mut blend = Self::EMPTY;
        blend.push(row, 1.0);
        blend
    }

    const EMPTY: Self = Self { rows: [0; Self::MAX], weights: [0.0; Self::MAX], len: 0 };

    /// Rows with positive weights, scaled to sum to 1; `None` if there are none.
    ///
    /// Only the first [`Self::MAX`] are taken.
    pub fn new(parts: impl IntoIterator<Item = (u32, f32)>) -> Option<Self> {
        let mut blend = Self::EMPTY;
        for (row, weight) in parts.into_iter().filter(|(_, w)| *w > 0.0).take(Self::MAX) {
            blend.push(row, weight);
        }
        let sum: f32 = blend.weights.iter().sum();
        blend.weights.iter_mut().for_each(|w| *w /= sum);
        (blend.len > 0).then_some(blend)
    }

    fn push(&mut self, row: u32, weight: f32) {
        let n = usize::from(self.len);
        (self.rows[n], self.weights[n]) = (row, weight);
        self.len += 1;
    }

    /// Rows of the table, each with its weight.
    pub fn iter(&self) -> impl Iterator<Item = (u32, f32)> + '_ {
        self.rows.iter().copied().zip(self.weights).take(self.len.into())
    }

    /// The same blend of a table that has `by` rows more in front.
    pub fn shifted(mut self, by: u32) -> Self {
        self.rows.iter_mut().for_each(|r| *r += by);
        self
    }
}

/// How a value between the centres of patches is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// The patch whose centre is nearest.
    Nearest,
    /// Between the four nearest centres, as LERF does; at the border, the nearest two or one.
    #[default]
    Bilinear,
}

/// Where the patches of a pyramid's level lie in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatchLayout {
    /// Width and height of a patch, px.
    pub size_px: [f64; 2],
    /// From one patch to the next, px; patch `n` starts at `floor(n * stride)`.
    pub stride_px: [f64; 2],
    /// Left upper corner of the first patch, px.
    pub origin_px: [f64; 2],
    /// Size of the image that these pixels are of.
    pub image_px: [f64; 2],
}

impl PatchLayout {
    /// Patches with half overlap that just cover the image; what is assumed where no `meta.json` says otherwise.
    pub fn covering(image_px: [f64; 2], cols: usize, rows: usize) -> Self {
        let stride = |length: f64, n: usize| length / (n as f64 + 1.0);
        let stride_px = [stride(image_px[0], cols), stride(image_px[1], rows)];
        let size = |axis: usize, n: usize| if n == 1 { image_px[axis] } else { 2.0 * stride_px[axis] };
        Self { size_px: [size(0, cols), size(1, rows)], stride_px, origin_px: [0.0; 2], image_px }
    }

    /// Height of a patch as a share of the image's: LERF's scale.
    pub fn scale(&self) -> f32 {
        (self.size_px[1] / self.image_px[1]) as f32
    }

    /// The same layout for the image at another resolution.
    ///
    /// Patches start at whole pixels of the image that they were cut from, so the layout is kept in those pixels and
    /// positions are scaled instead.
    fn to_own_px(self, axis: usize, image: f64, at: f64) -> f64 {
        at * self.image_px[axis] / image
    }

    fn centre(&self, axis: usize, n: usize) -> f64 {
        let start = (n as f64 * self.stride_px[axis]).floor();
        self.origin_px[axis] + start + self.size_px[axis] / 2.0
    }

    /// The two patches around a position along one axis, and how much the second counts.
    fn neighbours(&self, axis: usize, count: usize, at: f64) -> (usize, usize, f32) {
        let u = (at - self.centre(axis, 0)) / self.stride_px[axis];
        let first = (u.max(0.0) as usize).min(count - 1);
        let second = (first + 1).min(count - 1);
        if first == second {
            return (first, first, 0.0);
        }
        let (a, b) = (self.centre(axis, first), self.centre(axis, second));
        (first, second, ((at - a) / (b - a)).clamp(0.0, 1.0) as f32)
    }
}

/// One level of a pyramid of patches.
#[derive(Clone, Debug, PartialEq)]
pub struct PatchGrid {
    /// Where the patches are.
    pub layout: PatchLayout,
    /// Patches from top to bottom, at least 1.
    pub rows: usize,
    /// Patches from left to right, at least 1.
    pub cols: usize,
    /// `[rows * cols, dim]`.
    pub descriptors: Descriptors,
}

impl PatchGrid {
    /// Left, top, right and bottom of a patch in px of an image of `image_px`; `None` if it has no usable descriptor.
    pub fn area(&self, row: usize, col: usize, image_px: [f64; 2]) -> Option<[f64; 4]> {
        if !self.descriptors.is_usable(row * self.cols + col) {
            return None;
        }
        let side = |axis: usize, n: usize, end: f64| {
            let from_centre = (end - 0.5) * self.layout.size_px[axis];
            (self.layout.centre(axis, n) + from_centre) * image_px[axis] / self.layout.image_px[axis]
        };
        Some([side(0, col, 0.0), side(1, row, 0.0), side(0, col, 1.0), side(1, row, 1.0)])
    }

    /// The patches at a position (`[x, y]`, px of an image of `image_px`) as rows of `descriptors`.
    ///
    /// Patches without a usable descriptor do not count; `None` if no patch around has one.
    pub fn at(&self, position: [f64; 2], image_px: [f64; 2], how: Interpolation) -> Option<Blend> {
        let along = |axis: usize, count: usize| {
            let at = self.layout.to_own_px(axis, image_px[axis], position[axis]);
            let (first, second, t) = self.layout.neighbours(axis, count, at);
            match how {
                Interpolation::Bilinear => (first, second, t),
                Interpolation::Nearest => (first, second, t.round()),
            }
        };
        let (x0, x1, u) = along(0, self.cols);
        let (y0, y1, v) = along(1, self.rows);
        let row = |y: usize, x: usize| (y * self.cols + x) as u32;
        let corners = [
            (row(y0, x0), (1.0 - u) * (1.0 - v)),
            (row(y0, x1), u * (1.0 - v)),
            (row(y1, x0), (1.0 - u) * v),
            (row(y1, x1), u * v),
        ];
        Blend::new(corners.into_iter().filter(|(row, _)| self.descriptors.is_usable(*row as usize)))
    }
}

/// Descriptors of cells that tile the image without overlap.
#[derive(Clone, Debug, PartialEq)]
pub struct CellGrid {
    /// Cells from top to bottom, at least 1.
    pub rows: usize,
    /// Cells from left to right, at least 1.
    pub cols: usize,
    /// `[rows * cols, dim]`.
    pub descriptors: Descriptors,
}

impl CellGrid {
    /// Row of `descriptors` of the cell that holds a position (`[x, y]`, px of an image of `image_px`); `None` where it
    /// has no usable descriptor.
    pub fn at(&self, position: [f64; 2], image_px: [f64; 2]) -> Option<u32> {
        let x = cell(position[0], image_px[0], self.cols);
        let y = cell(position[1], image_px[1], self.rows);
        let row = y * self.cols + x;
        self.descriptors.is_usable(row).then_some(row as u32)
    }
}

/// Which of `count` equal cells along `length` holds a position.
pub(crate) fn cell(at: f64, length: f64, count: usize) -> usize {
    ((at / length * count as f64).max(0.0) as usize).min(count - 1)
}
