//! Structural similarity of two images.

use rayon::prelude::*;

/// Window width, px (Wang et al. 2004).
const WINDOW: usize = 11;
/// Standard deviation of the window's Gaussian, px.
const SIGMA: f64 = 1.5;
/// (0.01 L)² and (0.03 L)² for the dynamic range L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Mean SSIM of two sRGB images (Wang et al. 2004, eq. 13): 11 × 11 Gaussian window, σ = 1.5 px, values
/// 0–1, each channel by itself, averaged over the channels and over the pixels whose whole window lies
/// inside the image. The same figure as scikit-image's `structural_similarity(gaussian_weights=True,
/// sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1)`.
///
/// `a` and `b` are `[height * width]`; `None` when the image is smaller than the window or the lengths
/// disagree.
pub fn ssim(a: &[[u8; 3]], b: &[[u8; 3]], width: usize, height: usize) -> Option<f64> {
    if a.len() != width * height || b.len() != a.len() || width < WINDOW || height < WINDOW {
        return None;
    }
    let kernel = gaussian();
    let channels: Vec<f64> = (0..3usize)
        .into_par_iter()
        .map(|c| {
            let value = |image: &[[u8; 3]], i: usize| f64::from(image[i][c]) / 255.0;
            let moment = |f: &dyn Fn(f64, f64) -> f64| {
                let plane: Vec<f64> = (0..a.len()).map(|i| f(value(a, i), value(b, i))).collect();
                blur(&plane, width, height, &kernel)
            };
            let (mu_a, mu_b) = (moment(&|x, _| x), moment(&|_, y| y));
            let (aa, bb, ab) = (moment(&|x, _| x * x), moment(&|_, y| y * y), moment(&|x, y| x * y));
            let sum: f64 = (0..mu_a.len())
                .map(|i| {
                    let (ma, mb) = (mu_a[i], mu_b[i]);
                    let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
                    (2.0 * ma * mb + C1) * (2.0 * cov + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2))
                })
                .sum();
            sum / mu_a.len() as f64
        })
        .collect();
    Some(channels.iter().sum::<f64>() / 3.0)
}

fn gaussian() -> [f64; WINDOW] {
    let mut kernel = [0.0; WINDOW];
    let centre = (WINDOW / 2) as f64;
    for (i, k) in kernel.iter_mut().enumerate() {
        *k = (-(i as f64 - centre).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = kernel.iter().sum();
    kernel.map(|k| k / sum)
}

/// Separable filter; only pixels whose whole window lies inside: `[(height - 10) * (width - 10)]`.
fn blur(plane: &[f64], width: usize, height: usize, kernel: &[f64; WINDOW]) -> Vec<f64> {
    let inner = width - WINDOW + 1;
    let rows: Vec<f64> = plane
        .chunks_exact(width)
        .flat_map(|row| row.windows(WINDOW).map(|w| w.iter().zip(kernel).map(|(x, k)| x * k).sum::<f64>()))
        .collect();
    (0..(height - WINDOW + 1) * inner)
        .map(|i| (0..WINDOW).map(|k| rows[i + k * inner] * kernel[k]).sum())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 24 × 17 px pattern and a changed copy; `ssim_equals_scikit_image` quotes what Python makes of the
    /// same formula.
    fn pattern(changed: bool) -> Vec<[u8; 3]> {
        let value = |x: usize, y: usize, c: usize| {
            let v = (x * 37 + y * 91 + c * 53 + x * y * (c + 3)) % 256;
            (if changed { v * 3 / 4 + (x * 5 + y * 3) % 29 } else { v }) as u8
        };
        (0..24 * 17).map(|i| [0, 1, 2].map(|c| value(i % 24, i / 24, c))).collect()
    }

    #[test]
    fn identical_images_have_ssim_one() {
        let a = pattern(false);
        assert!((ssim(&a, &a, 24, 17).unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn ssim_equals_scikit_image() {
        let ours = ssim(&pattern(false), &pattern(true), 24, 17).unwrap();
        assert!((ours - SCIKIT_IMAGE).abs() < 1e-9, "{ours}");
    }

    #[test]
    fn small_or_mismatched_images_have_no_ssim() {
        let a = pattern(false);
        assert_eq!(ssim(&a[..10 * 10], &a[..10 * 10], 10, 10), None);
        assert_eq!(ssim(&a, &a[1..], 24, 17), None);
    }

    /// scikit-image 0.26, with the arguments that [`ssim()`] names, on the two patterns.
    const SCIKIT_IMAGE: f64 = 0.940470012635;
}
