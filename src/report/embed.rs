//! Pictures inside the page: PNG as `data:` addresses, so that the report is one file.

use std::io::Cursor;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::error::{ParameterError, ParameterErrorKind};
use image::{ExtendedColorType, ImageEncoder, ImageError};

/// A picture as the address of an `<img>`; `pixels` are `[height * width]` of 3 (RGB) or 4 (RGBA) bytes, sRGB.
///
/// # Errors
/// The number of bytes does not fit the size.
pub fn png_address<const N: usize>(
    pixels: &[[u8; N]],
    width: usize,
    height: usize,
) -> Result<String, ImageError> {
    // The encoder itself panics on a buffer of another length.
    if pixels.len() != width * height {
        return Err(ImageError::Parameter(ParameterError::from_kind(ParameterErrorKind::DimensionMismatch)));
    }
    let kind = if N == 4 { ExtendedColorType::Rgba8 } else { ExtendedColorType::Rgb8 };
    let mut png = Cursor::new(Vec::new());
    PngEncoder::new_with_quality(&mut png, CompressionType::Default, FilterType::Adaptive).write_image(
        pixels.as_flattened(),
        width as u32,
        height as u32,
        kind,
    )?;
    Ok(format!("data:image/png;base64,{}", base64(png.get_ref())))
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let [a, b, c] = [0, 1, 2].map(|n| u32::from(group.get(n).copied().unwrap_or(0)));
        let bits = a << 16 | b << 8 | c;
        for n in 0..4 {
            // A group of k bytes has k + 1 digits; the rest is padding.
            let digit = ALPHABET[(bits >> (18 - 6 * n) & 63) as usize];
            text.push(if n <= group.len() { digit.into() } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_gives_the_vectors_of_rfc_4648() {
        for (plain, coded) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xfe]), "+//+");
    }

    #[test]
    fn pictures_of_the_wrong_size_are_refused() {
        assert!(png_address(&[[0u8; 3]; 6], 3, 2).is_ok());
        assert!(png_address(&[[0u8; 3]; 5], 3, 2).is_err());
    }
}
