//! Per-pixel measures, pooled over frames: PSNR, depth error, stream IoU.

use super::EvalError;
use super::truth::FrameTruth;
use crate::scene::Frame;

/// A stream is scored in a frame where the truth gives it at least so many pixels.
const MIN_PIXELS: usize = 50;

/// What was rendered for one frame; all layers are row-major `[height * width]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedView {
    /// All streams, sRGB.
    pub rgb: Vec<[u8; 3]>,
    /// Depth along the camera's z axis, world units.
    pub depth: Option<Vec<f32>>,
    /// Opacity of the persistent, the dynamic and the actor's stream.
    pub streams: Option<[Vec<f32>; 3]>,
}

/// Sums over frames. Add every test frame, in order, then read the measures.
#[derive(Clone, Debug, Default)]
pub struct ImageSums {
    sse: f64,
    values: usize,
    sse_persistent: f64,
    values_persistent: usize,
    ssim: Vec<f64>,
    depth_errors: Vec<f32>,
    stream_ious: [Vec<f64>; 3],
}

impl ImageSums {
    /// Compares one rendered frame with what there is of the truth.
    ///
    /// # Errors
    /// [`EvalError::Size`] when a layer is not as large as the camera, [`EvalError::NonFinite`] for NaN in
    /// a layer.
    pub fn add(&mut self, frame: &Frame, view: &RenderedView, truth: &FrameTruth) -> Result<(), EvalError> {
        check_size(frame, "rendered colour", view.rgb.len())?;
        self.add_colour(frame, view, truth);
        if let (Some(ours), Some(truth)) = (&view.depth, &truth.depth) {
            check_layer(frame, "depth", ours)?;
            let pairs = ours.iter().zip(truth).filter(|(_, t)| **t > 0.0);
            self.depth_errors.extend(pairs.map(|(z, t)| (z - t).abs()));
        }
        if let (Some(ours), Some(truth)) = (&view.streams, &truth.streams) {
            for opacity in ours {
                check_layer(frame, "stream opacity", opacity)?;
            }
            self.add_streams(ours, truth);
        }
        Ok(())
    }

    fn add_colour(&mut self, frame: &Frame, view: &RenderedView, truth: &FrameTruth) {
        for (i, (a, b)) in view.rgb.iter().zip(&truth.rgb).enumerate() {
            let sse: f64 = (0..3).map(|c| ((f64::from(a[c]) - f64::from(b[c])) / 255.0).powi(2)).sum();
            self.sse += sse;
            self.values += 3;
            if truth.streams.as_ref().is_some_and(|s| s[i] == 0) {
                self.sse_persistent += sse;
                self.values_persistent += 3;
            }
        }
        let (width, height) = (frame.camera.width as usize, frame.camera.height as usize);
        self.ssim.extend(super::ssim(&view.rgb, &truth.rgb, width, height));
    }

    fn add_streams(&mut self, opacities: &[Vec<f32>; 3], truth: &[u8]) {
        let mut intersection = [0usize; 3];
        let mut union = [0usize; 3];
        let mut covered = [0usize; 3];
        for (i, &label) in truth.iter().enumerate() {
            let ours = argmax(opacities.each_ref().map(|o| o[i]));
            for s in 0..3 {
                let (a, b) = (ours == s, usize::from(label) == s);
                intersection[s] += usize::from(a && b);
                union[s] += usize::from(a || b);
                covered[s] += usize::from(b);
            }
        }
        for s in 0..3 {
            if covered[s] >= MIN_PIXELS {
                self.stream_ious[s].push(intersection[s] as f64 / union[s] as f64);
            }
        }
    }

    /// dB over all pixels added; `None` without pixels, infinite for identical images.
    pub fn psnr(&self) -> Option<f64> {
        psnr(self.sse, self.values)
    }

    /// dB over the pixels whose true stream is persistent; `None` without true streams.
    pub fn psnr_persistent(&self) -> Option<f64> {
        psnr(self.sse_persistent, self.values_persistent)
    }

    /// Mean SSIM of the frames; `None` when none is large enough for the 11 × 11 window.
    pub fn ssim(&self) -> Option<f64> {
        mean(&self.ssim)
    }

    /// Median of |z − z_true| over the pixels with a true depth, world units.
    pub fn depth_median_abs(&self) -> Option<f64> {
        median(self.depth_errors.clone())
    }

    /// Mean IoU of the persistent, dynamic and actor pixels over the frames where the truth covers 50 px.
    /// A pixel belongs to the stream with the largest opacity.
    pub fn stream_ious(&self) -> [Option<f64>; 3] {
        self.stream_ious.each_ref().map(|v| mean(v))
    }
}

fn psnr(sse: f64, values: usize) -> Option<f64> {
    (values > 0).then(|| -10.0 * (sse / values as f64).log10())
}

/// Arithmetic mean; `None` of nothing.
pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Median; the mean of the middle two for an even count.
fn median(mut values: Vec<f32>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let half = values.len() / 2;
    let odd = values.len() % 2 == 1;
    let (below, upper, _) = values.select_nth_unstable_by(half, f32::total_cmp);
    let upper = f64::from(*upper);
    if odd {
        return Some(upper);
    }
    let lower = below.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    Some((f64::from(lower) + upper) / 2.0)
}

/// The first of the largest.
fn argmax(v: [f32; 3]) -> usize {
    (1..3).fold(0, |best, i| if v[i] > v[best] { i } else { best })
}

/// That an image of `len` pixels fits the frame's camera.
pub(super) fn check_size(frame: &Frame, what: &'static str, len: usize) -> Result<(), EvalError> {
    let (width, height) = (frame.camera.width, frame.camera.height);
    if len == width as usize * height as usize {
        return Ok(());
    }
    Err(EvalError::Size { what, frame: frame.stem.clone(), got: len, width, height })
}

fn check_layer(frame: &Frame, what: &'static str, values: &[f32]) -> Result<(), EvalError> {
    check_size(frame, what, values.len())?;
    match values.iter().position(|v| !v.is_finite()) {
        Some(pixel) => Err(EvalError::NonFinite { what, frame: frame.stem.clone(), pixel }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::truth::tests::frame;

    fn truth(n: usize) -> FrameTruth {
        let streams = (0..n).map(|i| if i < n / 2 { 0 } else { 1 }).collect();
        FrameTruth { rgb: vec![[100; 3]; n], depth: Some(vec![2.0; n]), streams: Some(streams) }
    }

    #[test]
    fn known_errors_give_known_measures() {
        let (f, t) = (frame(20, 10), truth(200));
        // Half the pixels (the persistent ones) are off by 51/255 = 0.2, the rest are exact.
        let rgb = (0..200).map(|i| if i < 100 { [151; 3] } else { [100; 3] }).collect();
        let depth = (0..200).map(|i| 2.0 + i as f32 * 0.01).collect();
        // 80 px called persistent of which all are; 120 called dynamic of which 100 are.
        let persistent = (0..200).map(|i| if i < 80 { 0.9 } else { 0.1 }).collect();
        let view = RenderedView {
            rgb,
            depth: Some(depth),
            streams: Some([persistent, vec![0.5; 200], vec![0.0; 200]]),
        };
        let mut sums = ImageSums::default();
        sums.add(&f, &view, &t).unwrap();
        assert!((sums.psnr().unwrap() - -10.0 * 0.02f64.log10()).abs() < 1e-9);
        assert!((sums.psnr_persistent().unwrap() - -10.0 * 0.04f64.log10()).abs() < 1e-9);
        assert!((sums.depth_median_abs().unwrap() - 0.995).abs() < 1e-5);
        let [p, d, a] = sums.stream_ious();
        assert!((p.unwrap() - 0.8).abs() < 1e-12 && (d.unwrap() - 100.0 / 120.0).abs() < 1e-12);
        assert_eq!(a, None, "a stream that the truth does not show has no score");
    }

    #[test]
    fn pixels_without_true_depth_do_not_count() {
        let mut t = truth(200);
        t.depth.as_mut().unwrap()[1..].fill(0.0);
        let view = RenderedView { rgb: t.rgb.clone(), depth: Some(vec![2.5; 200]), streams: None };
        let mut sums = ImageSums::default();
        sums.add(&frame(20, 10), &view, &t).unwrap();
        assert_eq!(sums.depth_median_abs(), Some(0.5));
    }

    #[test]
    fn wrong_sizes_and_nan_are_errors() {
        let (f, t) = (frame(20, 10), truth(200));
        let mut sums = ImageSums::default();
        let short = RenderedView { rgb: vec![[0; 3]; 199], ..Default::default() };
        assert!(matches!(sums.add(&f, &short, &t), Err(EvalError::Size { got: 199, .. })));
        let mut depth = vec![1.0; 200];
        depth[7] = f32::NAN;
        let nan = RenderedView { rgb: t.rgb.clone(), depth: Some(depth), streams: None };
        assert!(matches!(sums.add(&f, &nan, &t), Err(EvalError::NonFinite { pixel: 7, .. })));
    }

    #[test]
    fn no_frames_give_no_measures() {
        let sums = ImageSums::default();
        assert_eq!((sums.psnr(), sums.ssim(), sums.depth_median_abs()), (None, None, None));
    }
}
