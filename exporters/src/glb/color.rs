//! sRGB bytes ↔ the linear 16-bit colours that glTF prescribes.

/// Linear intensity of every sRGB byte, as normalised u16 (IEC 61966-2-1).
pub(super) fn linear_u16_table() -> [u16; 256] {
    std::array::from_fn(|byte| {
        let encoded = byte as f64 / 255.0;
        let linear = if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
        (linear * 65535.0).round() as u16
    })
}

/// The sRGB byte nearest to a linear intensity in 0..1; the exact inverse of [`linear_u16_table`].
pub(super) fn srgb_from_linear(linear: f32) -> u8 {
    let linear = f64::from(linear.clamp(0.0, 1.0));
    let encoded = if linear <= 0.0031308 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_srgb_byte_survives_the_way_through_linear_u16() {
        let table = linear_u16_table();
        for byte in 0..=255u8 {
            assert_eq!(srgb_from_linear(f32::from(table[usize::from(byte)]) / 65535.0), byte);
        }
        assert_eq!((table[0], table[255]), (0, 65535));
    }
}
