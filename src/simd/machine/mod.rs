//! Single instructions that no safe interface has: the one module of this crate with `unsafe` code.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
pub mod amx;

/// Asks for the cache line `bytes` behind `value` before it is needed; on other processors than x86-64, their own
/// prediction has to do.
#[inline(always)]
pub fn prefetch<T>(value: &T, bytes: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at = std::ptr::from_ref(value).cast::<i8>().wrapping_add(bytes);
        // SAFETY: a hint; whatever the address, nothing is read that the program would see, and nothing faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (value, bytes);
}
