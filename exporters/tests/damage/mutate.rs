//! Seeded damage: the same content and seed give the same damaged content.

use std::ops::Range;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }

    fn pick<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }

    /// A short range inside `length`.
    fn range(&mut self, length: usize) -> Range<usize> {
        let start = self.below(length);
        let longest = *self.pick(&[1, 4, 16, 64, 1024]);
        start..(start + 1 + self.below(longest)).min(length)
    }
}

/// Integers at which lengths and offsets go wrong.
const EDGES: [u64; 12] = [
    0,
    1,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    0x7fff_ffff_ffff_ffff,
    0xffff_ffff_ffff_ffff,
];

/// The same for numbers in text, and words that parsers know.
const WORDS: [&str; 14] = [
    "0",
    "-1",
    "3",
    "255",
    "65536",
    "2147483648",
    "4294967295",
    "18446744073709551615",
    "99999999999999999999",
    "1e308",
    "1e999",
    "nan",
    "null",
    "[]",
];

/// One to four changes.
pub fn mutate(content: &[u8], seed: u64) -> Vec<u8> {
    let mut random = Random(seed);
    let mut bytes = content.to_vec();
    for _ in 0..1 + random.below(4) {
        if bytes.is_empty() {
            break;
        }
        change(&mut bytes, &mut random);
    }
    bytes
}

fn change(bytes: &mut Vec<u8>, random: &mut Random) {
    let at = random.below(bytes.len());
    match random.below(9) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = random.next() as u8,
        2 | 3 => {
            let edge = random.pick(&EDGES).to_le_bytes();
            let width = *random.pick(&[1, 2, 4, 8]);
            for (to, byte) in bytes[at..].iter_mut().zip(&edge[..width]) {
                *to = *byte;
            }
        }
        4 => replace_number(bytes, at, random),
        5 => drop(bytes.drain(random.range(bytes.len()))),
        6 => {
            let range = random.range(bytes.len());
            let copy = bytes[range].to_vec();
            bytes.splice(at..at, copy);
        }
        7 => {
            let range = random.range(bytes.len());
            let byte = *random.pick(&[0, b' ', b'\n', b'"', 0xff]);
            bytes[range].fill(byte);
        }
        _ => bytes.truncate(at),
    }
}

/// Puts another number or word in the place of the number in text that comes next.
fn replace_number(bytes: &mut Vec<u8>, at: usize, random: &mut Random) {
    let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit).map(|skip| at + skip) else { return };
    let length = bytes[start..].iter().take_while(|byte| byte.is_ascii_digit() || **byte == b'.').count();
    let word = *random.pick(&WORDS);
    bytes.splice(start..start + length, word.bytes());
}
