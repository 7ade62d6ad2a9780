//! The CPU's matrix units (Intel AMX, bf16).
//!
//! Rust's AMX intrinsics are not stable, so the tile instructions are inline assembly. Everything here is behind the
//! safe type [`Tiles`]; its twin in plain code is in [`crate::simd::matrix`].

use std::arch::asm;
use std::marker::PhantomData;
use std::sync::OnceLock;

use super::dots::{Dots, INTERLEAVED, load_order};
use crate::simd::matrix::{Keep, Narrowed, PANEL, Pairs, TILE_ROWS};

/// Bytes of a tile register's row: 32 bf16, 16 pairs of them or 16 f32.
const ROW_BYTES: usize = 64;

/// Bytes from one row of a panel of f32 or pairs to the next.
const PANEL_BYTES: usize = PANEL * 4;

/// Whether this process may use AMX with bf16: the CPU has it and the kernel lets us keep the tiles' state.
pub fn available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| has_instructions() && has_permission())
}

fn has_instructions() -> bool {
    const TILE: u32 = 1 << 24;
    const BF16: u32 = 1 << 22;
    let leaves = std::arch::x86_64::__cpuid(0).eax;
    let has = leaves >= 7 && std::arch::x86_64::__cpuid_count(7, 0).edx & (TILE | BF16) == TILE | BF16;
    has && Dots::new().is_some()
}

/// Asks Linux for the tiles' 8 KiB of state, for all threads; a kernel that grants it saves it on every switch.
#[cfg(target_os = "linux")]
fn has_permission() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_long = 18;
    // SAFETY: this call takes two numbers and touches no memory of ours.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

#[cfg(not(target_os = "linux"))]
fn has_permission() -> bool {
    false
}

/// What `ldtilecfg` reads: palette 1, eight tiles of 16 rows of 64 bytes.
#[repr(C, align(64))]
struct TileConfig {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

/// Proof that the tile registers of this thread are configured.
///
/// They stay so: every holder wants the same configuration, and one may end before another of the same thread.
pub struct Tiles {
    /// The registers belong to the thread: neither `Send` nor `Sync`.
    thread: PhantomData<*mut ()>,
}

impl Tiles {
    /// Configures this thread's tile registers; `None` where there are none.
    pub fn new() -> Option<Self> {
        if !available() {
            return None;
        }
        let mut config =
            TileConfig { palette: 1, start_row: 0, reserved: [0; 14], row_bytes: [0; 16], rows: [0; 16] };
        config.row_bytes[..8].fill(ROW_BYTES as u16);
        config.rows[..8].fill(TILE_ROWS as u8);
        // SAFETY: `available` has checked CPU and kernel; the 64 bytes that are read are a valid configuration.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const config, options(nostack, readonly)) };
        Some(Self { thread: PhantomData })
    }

    /// c = A B for 16 rows of A and a panel of 48 columns; see [`crate::simd::matrix::Unit::panel`].
    #[inline(always)]
    pub fn panel(&self, a: &[u16], b: &[Pairs], c: &mut [f32]) {
        let blocks = a.len() / (TILE_ROWS * 32);
        assert!(blocks > 0 && b.len() >= blocks * TILE_ROWS * PANEL && c.len() >= TILE_ROWS * PANEL);
        // SAFETY: the registers are configured (`self`); per block 16 × 64 bytes of `a` and 16 rows of 192 bytes of `b`
        // are read, and 16 rows of 192 bytes of `c` written, all within the slices by the assertion above.
        unsafe {
            asm!(
                "tilezero tmm0",
                "tilezero tmm1",
                "tilezero tmm2",
                "2:",
                "tileloadd tmm3, [{a} + {a_row}*1]",
                "tileloadd tmm4, [{b} + {row}*1]",
                "tileloadd tmm5, [{b} + {row}*1 + 64]",
                "tileloadd tmm6, [{b} + {row}*1 + 128]",
                "tdpbf16ps tmm0, tmm3, tmm4",
                "tdpbf16ps tmm1, tmm3, tmm5",
                "tdpbf16ps tmm2, tmm3, tmm6",
                "add {a}, 1024",
                "add {b}, 3072",
                "dec {blocks}",
                "jnz 2b",
                "tilestored [{c} + {row}*1], tmm0",
                "tilestored [{c} + {row}*1 + 64], tmm1",
                "tilestored [{c} + {row}*1 + 128], tmm2",
                a = inout(reg) a.as_ptr() => _,
                b = inout(reg) b.as_ptr() => _,
                c = in(reg) c.as_mut_ptr(),
                a_row = in(reg) ROW_BYTES,
                row = in(reg) PANEL_BYTES,
                blocks = inout(reg) blocks => _,
                options(nostack),
            );
        }
    }

    /// c = A B for a block of 32 × 32 and a long inner dimension; see [`crate::simd::matrix::Unit::outer`].
    #[inline(always)]
    pub fn outer(
        &self,
        a: &[u16],
        a_stride: usize,
        b: [&[Pairs]; 2],
        blocks: usize,
        c: &mut [[f32; 256]; 4],
    ) {
        assert!(blocks > 0 && a.len() >= 31 * a_stride + 32 * blocks && a_stride >= 32 * blocks);
        assert!(b.iter().all(|b| b.len() >= blocks * TILE_ROWS * 16));
        // SAFETY: the registers are configured (`self`); 32 rows of `blocks` × 64 bytes of `a`, `blocks` KiB of each `b`
        // are read and 4 KiB of `c` written, all within the slices by the assertions above.
        unsafe {
            asm!(
                "tilezero tmm0",
                "tilezero tmm1",
                "tilezero tmm2",
                "tilezero tmm3",
                "2:",
                "tileloadd tmm4, [{a0} + {a_row}*1]",
                "tileloadd tmm5, [{a1} + {a_row}*1]",
                "tileloadd tmm6, [{b0} + {row}*1]",
                "tileloadd tmm7, [{b1} + {row}*1]",
                "tdpbf16ps tmm0, tmm4, tmm6",
                "tdpbf16ps tmm1, tmm4, tmm7",
                "tdpbf16ps tmm2, tmm5, tmm6",
                "tdpbf16ps tmm3, tmm5, tmm7",
                "add {a0}, 64",
                "add {a1}, 64",
                "add {b0}, 1024",
                "add {b1}, 1024",
                "dec {blocks}",
                "jnz 2b",
                "tilestored [{c} + {row}*1], tmm0",
                "tilestored [{c} + {row}*1 + 1024], tmm1",
                "tilestored [{c} + {row}*1 + 2048], tmm2",
                "tilestored [{c} + {row}*1 + 3072], tmm3",
                a0 = inout(reg) a.as_ptr() => _,
                a1 = inout(reg) a[16 * a_stride..].as_ptr() => _,
                b0 = inout(reg) b[0].as_ptr() => _,
                b1 = inout(reg) b[1].as_ptr() => _,
                c = in(reg) c.as_mut_ptr(),
                a_row = in(reg) a_stride * 2,
                row = in(reg) ROW_BYTES,
                blocks = inout(reg) blocks => _,
                options(nostack),
            );
        }
    }

    /// See [`crate::simd::matrix::Unit::narrow`].
    #[inline(always)]
    pub fn narrow(&self, rows: &[f32; 2 * PANEL], bias: [f32; 2], keep: Keep, out: Narrowed) {
        // SAFETY: `available` has checked for these instructions.
        unsafe { narrow(rows, bias, keep, out) }
    }

    /// See [`crate::simd::matrix::Unit::transpose`].
    #[inline(always)]
    pub fn transpose(&self, rows: &[Pairs], stride: usize, out: &mut [Pairs; 256]) {
        assert!(rows.len() >= 15 * stride + 16);
        // SAFETY: `available` has checked for AVX-512; 64 bytes at each of 16 strides are within `rows`.
        unsafe { transpose(rows.as_ptr(), stride, out) }
    }
}

/// # Safety
/// The CPU has AVX-512 with its extensions for bytes and words, and for bf16.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn narrow(rows: &[f32; 2 * PANEL], bias: [f32; 2], keep: Keep, mut out: Narrowed) {
    use std::arch::x86_64::*;
    let interleaved = load_order(&INTERLEAVED);
    // SAFETY: every load and store is of 16 numbers from `v` on, within rows of 48.
    unsafe {
        for v in (0..PANEL).step_by(16) {
            let mut low = _mm512_add_ps(_mm512_loadu_ps(rows.as_ptr().add(v)), _mm512_set1_ps(bias[0]));
            let mut high =
                _mm512_add_ps(_mm512_loadu_ps(rows.as_ptr().add(PANEL + v)), _mm512_set1_ps(bias[1]));
            if let Keep::Positive = keep {
                // The second operand where one of them is not a number.
                low = _mm512_max_ps(_mm512_setzero_ps(), low);
                high = _mm512_max_ps(_mm512_setzero_ps(), high);
            }
            let mut both: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(high, low));
            if let Keep::Where([a, b]) = keep {
                let a = _mm256_loadu_si256(a.as_ptr().add(v).cast());
                let b = _mm256_loadu_si256(b.as_ptr().add(v).cast());
                let x = _mm512_inserti64x4::<1>(_mm512_castsi256_si512(a), b);
                both = _mm512_maskz_mov_epi16(_mm512_test_epi16_mask(x, x), both);
            }
            let [a, b] = &mut out.rows;
            _mm256_storeu_si256(a.as_mut_ptr().add(v).cast(), _mm512_castsi512_si256(both));
            _mm256_storeu_si256(b.as_mut_ptr().add(v).cast(), _mm512_extracti64x4_epi64::<1>(both));
            let pairs = _mm512_permutexvar_epi16(interleaved, both);
            _mm512_storeu_si512(out.pairs.as_mut_ptr().add(v).cast(), pairs);
        }
    }
}

/// # Safety
/// The CPU has AVX-512, and 16 numbers can be read at `rows` and every `stride` from it up to the 15th.
#[target_feature(enable = "avx512f")]
unsafe fn transpose(rows: *const Pairs, stride: usize, out: &mut [Pairs; 256]) {
    use std::arch::x86_64::*;
    let zero = _mm512_setzero_si512();
    let (mut a, mut b) = ([zero; 16], [zero; 16]);
    for n in 0..16 {
        // SAFETY: the caller vouches for these 64 bytes.
        a[n] = unsafe { _mm512_loadu_si512(rows.add(n * stride).cast()) };
    }
    for n in 0..8 {
        b[2 * n] = _mm512_unpacklo_epi32(a[2 * n], a[2 * n + 1]);
        b[2 * n + 1] = _mm512_unpackhi_epi32(a[2 * n], a[2 * n + 1]);
    }
    // Afterwards quarter L of a[4 n + c] holds column 4 L + c of rows 4 n to 4 n + 3.
    for n in (0..16).step_by(4) {
        a[n] = _mm512_unpacklo_epi64(b[n], b[n + 2]);
        a[n + 1] = _mm512_unpackhi_epi64(b[n], b[n + 2]);
        a[n + 2] = _mm512_unpacklo_epi64(b[n + 1], b[n + 3]);
        a[n + 3] = _mm512_unpackhi_epi64(b[n + 1], b[n + 3]);
    }
    for c in 0..4 {
        let (upper, lower) = ((a[c], a[4 + c]), (a[8 + c], a[12 + c]));
        let even =
            [_mm512_shuffle_i32x4::<0x88>(upper.0, upper.1), _mm512_shuffle_i32x4::<0x88>(lower.0, lower.1)];
        let odd =
            [_mm512_shuffle_i32x4::<0xdd>(upper.0, upper.1), _mm512_shuffle_i32x4::<0xdd>(lower.0, lower.1)];
        b[c] = _mm512_shuffle_i32x4::<0x88>(even[0], even[1]);
        b[4 + c] = _mm512_shuffle_i32x4::<0x88>(odd[0], odd[1]);
        b[8 + c] = _mm512_shuffle_i32x4::<0xdd>(even[0], even[1]);
        b[12 + c] = _mm512_shuffle_i32x4::<0xdd>(odd[0], odd[1]);
    }
    for (column, out) in b.iter().zip(out.chunks_exact_mut(16)) {
        // SAFETY: `out` has 16 numbers.
        unsafe { _mm512_storeu_si512(out.as_mut_ptr().cast(), *column) };
    }
}
