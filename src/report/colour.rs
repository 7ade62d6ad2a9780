//! From numbers to colours.

/// Colours of the three streams in pictures, sRGB: blue for what stays, orange for what is moved, pink for who moves it.
pub const STREAM_COLOURS: [[u8; 3]; 3] = [[92, 120, 168], [255, 159, 28], [232, 72, 120]];

/// The Turbo colour map at `x` in [0, 1] (A. Mikhailov, 2019; the polynomial approximation of R. Du).
pub fn turbo(x: f32) -> [u8; 3] {
    const RED: [f32; 6] = [0.135_721_38, 4.615_392_6, -42.660_323, 132.131_08, -152.942_4, 59.286_38];
    const GREEN: [f32; 6] = [0.091_402_61, 2.194_188_4, 4.842_966_6, -14.185_033, 4.277_298_6, 2.829_566];
    const BLUE: [f32; 6] = [0.106_673_3, 12.641_946, -60.582_05, 110.362_77, -89.903_11, 27.348_25];
    let x = x.clamp(0.0, 1.0);
    let at = |c: &[f32; 6]| c.iter().rev().fold(0.0, |sum, c| sum * x + c);
    [at(&RED), at(&GREEN), at(&BLUE)].map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
}

/// Depths as colours, near red and far blue; black where there is none (0). The range spans all but the nearest and
/// farthest 2 %.
pub fn depth_picture(depth: &[f32], range: Option<[f32; 2]>) -> Vec<[u8; 3]> {
    let Some([near, far]) = range else { return vec![[0; 3]; depth.len()] };
    let scale = 1.0 / (far - near).max(1e-6);
    depth
        .iter()
        .map(|z| if *z > 0.0 { turbo(0.95 - 0.9 * ((z - near) * scale).clamp(0.0, 1.0)) } else { [0; 3] })
        .collect()
}

/// The range of depths that is worth colours; `None` where nothing has a depth.
pub fn depth_range(depth: &[f32]) -> Option<[f32; 2]> {
    let mut there: Vec<f32> = depth.iter().copied().filter(|z| *z > 0.0 && z.is_finite()).collect();
    there.sort_by(f32::total_cmp);
    let last = there.len().checked_sub(1)?;
    Some([there[last * 2 / 100], there[last * 98 / 100]])
}

/// Opacities of the streams as a mixture of their colours.
pub fn stream_picture(opacity: &[[f32; 3]]) -> Vec<[u8; 3]> {
    let mix = |o: &[f32; 3]| {
        std::array::from_fn(|c| {
            let sum: f32 = (0..3).map(|s| o[s].max(0.0) * f32::from(STREAM_COLOURS[s][c])).sum();
            (sum + 0.5).clamp(0.0, 255.0) as u8
        })
    };
    opacity.iter().map(mix).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turbo_runs_from_blue_over_green_to_red() {
        let [dark, green, red] = [turbo(0.1), turbo(0.5), turbo(0.95)];
        assert!(dark[2] > dark[0] && dark[2] > dark[1], "{dark:?}");
        assert!(green[1] > green[0] && green[1] > green[2], "{green:?}");
        assert!(red[0] > red[1] && red[0] > red[2], "{red:?}");
        assert_eq!(turbo(-1.0), turbo(0.0));
        // The constant terms of the published polynomial; the published table starts a little bluer.
        assert_eq!(turbo(0.0), [35, 23, 27]);
    }

    #[test]
    fn depth_pictures_ignore_holes_and_outliers() {
        let mut depth: Vec<f32> = (1..=100).map(|n| n as f32).collect();
        depth.extend([0.0, 1e6]);
        let [near, far] = depth_range(&depth).unwrap();
        assert!((1.0..5.0).contains(&near) && (95.0..=100.0).contains(&far));
        let picture = depth_picture(&depth, Some([near, far]));
        assert_eq!(picture[100], [0; 3]);
        assert!(picture[0][0] > picture[0][2] && picture[99][2] > picture[99][0], "near is red, far is blue");
        assert_eq!(depth_range(&[0.0, f32::NAN]), None);
    }
}
