//! Damage to bytes: the same for the same seed.

use crate::rng::Rng;
use crate::support::crc32;

/// Bytes within which every second piece of damage lies.
const HEAD: usize = 4096;

/// Counts and sizes that programs tend not to expect.
const HUGE: [u64; 6] = [0, u64::MAX, i64::MAX as u64, 1 << 63, u32::MAX as u64, i32::MAX as u64];

/// Numbers and words that stand where a number is expected.
const WORDS: [&str; 16] = [
    "0",
    "-1",
    "1e308",
    "-1e308",
    "1e-308",
    "1e999",
    "0.5",
    "255",
    "65536",
    "4294967295",
    "18446744073709551615",
    "99999999999999999999999",
    "NaN",
    "null",
    "\"\"",
    "[]",
];

/// `bytes` with one to three pieces of damage. Checksums and lengths that would give it away at once are put right.
pub fn damaged(bytes: &[u8], rng: &mut Rng) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for _ in 0..1 + rng.below(3) {
        damage(&mut out, rng);
    }
    if rng.below(2) == 0 {
        repair_png(&mut out);
        repair_safetensors(bytes, &mut out);
    }
    out
}

fn damage(out: &mut Vec<u8>, rng: &mut Rng) {
    if out.is_empty() {
        return out.push(rng.next_u64() as u8);
    }
    // What decides how a file is read is at its beginning.
    let within = if rng.below(2) == 0 { out.len().min(HEAD) } else { out.len() };
    let at = rng.below(within);
    let end = out.len().min(at + 1 + rng.below(24));
    match rng.below(9) {
        0 => out[at] ^= 1 << rng.below(8),
        1 => out[at] = rng.next_u64() as u8,
        2 => {
            let (value, width) = (HUGE[rng.below(HUGE.len())], 1 << rng.below(4));
            let number =
                if rng.below(2) == 0 { value.to_le_bytes() } else { value.rotate_left(32).to_be_bytes() };
            for (byte, new) in out[at..].iter_mut().zip(number).take(width) {
                *byte = new;
            }
        }
        3 => drop(out.drain(at..end)),
        4 => {
            let copy = out[at..end].to_vec();
            let to = rng.below(out.len());
            out.splice(to..to, copy);
        }
        5 => {
            let noise: Vec<u8> = (at..end).map(|_| rng.next_u64() as u8).collect();
            out.splice(at..at, noise);
        }
        6 => {
            let to = rng.below(out.len());
            for k in 0..(end - at).min(out.len() - to) {
                out[to + k] = out[at + k];
            }
        }
        7 if rng.below(4) == 0 => out.truncate(at),
        _ => replace_number(out, at, WORDS[rng.below(WORDS.len())]),
    }
}

/// Puts `word` in the place of the first number behind `from`, as text has it.
fn replace_number(out: &mut Vec<u8>, from: usize, word: &str) {
    let is_part = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
    let Some(digit) = out[from..].iter().position(u8::is_ascii_digit) else { return };
    let start = out[..from + digit].iter().rposition(|b| !is_part(b)).map_or(0, |n| n + 1);
    let length = out[start..].iter().position(|b| !is_part(b)).unwrap_or(out.len() - start);
    out.splice(start..start + length, word.bytes());
}

/// Gives every chunk of a PNG the checksum of what it holds now.
fn repair_png(out: &mut [u8]) {
    if !out.starts_with(b"\x89PNG\r\n\x1a\n") {
        return;
    }
    let mut at = 8;
    while let Some(length) = out.get(at..at + 4) {
        let length = u32::from_be_bytes([length[0], length[1], length[2], length[3]]) as usize;
        let end = at.saturating_add(8).saturating_add(length);
        let (Some(body), true) = (out.get(at + 4..end), out.len() >= end.saturating_add(4)) else { return };
        let sum = crc32(body.iter().copied()).to_be_bytes();
        out[end..end + 4].copy_from_slice(&sum);
        at = end + 4;
    }
}

/// Makes the length in front of a safetensors header that of the header as it is now.
fn repair_safetensors(whole: &[u8], out: &mut [u8]) {
    let is_header = whole.get(8) == Some(&b'{') && out.get(8) == Some(&b'{');
    let Some(end) = out.windows(3).rposition(|w| w == b"]}}").filter(|_| is_header) else { return };
    // Padded with blanks to a multiple of eight.
    let blanks = out[end + 3..].iter().take(7).take_while(|b| **b == b' ').count();
    let length = (end + 3 + blanks - 8) as u64;
    out[..8].copy_from_slice(&length.to_le_bytes());
}
