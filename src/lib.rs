//! Semantic 3D maps from egocentric video, on a plain CPU.
//!
//! ```text
//! scene → field → render → train → extract → map → files
//! ```
#![forbid(unsafe_code)]

pub mod extract;
pub mod field;
pub mod scene;
mod simd;
#[doc(hidden)]
pub fn bench_mlp() {
    use field::mlp::*;
    use simd::*;
    struct K<'a>(&'a Mlp, &'a Packed, &'a mut [f32], &'a mut [f32], usize, &'a mut [f32]);
    impl pulp::WithSimd for K<'_> {
        type Output = [f64; 3];
        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, simd: S) -> [f64; 3] {
            let K(m, p, t, g, n, out) = self;
            let st = m.rows() * TILE;
            let t0 = std::time::Instant::now();
            for i in 0..n { m.forward(simd, p, &mut t[i * st..][..st]); }
            let t1 = std::time::Instant::now();
            for i in 0..n { m.backward(simd, p, &t[i * st..][..st], &mut g[i * st..][..st], true); }
            let t2 = std::time::Instant::now();
            m.accumulate(simd, TileView{data:t,stride:st,offset:0}, TileView{data:g,stride:st,offset:0}, n, out);
            let t3 = t2.elapsed().as_secs_f64();
            [(t1 - t0).as_secs_f64(), (t2 - t1).as_secs_f64(), t3]
        }
    }
    for widths in [&[32usize, 64, 16][..], &[24, 64, 4], &[40, 64, 64, 8]] {
        let m = Mlp::new(widths);
        let mut s = 1u32;
        let params = m.init(|| { s = s.wrapping_mul(1664525).wrapping_add(1013904223); (s >> 8) as f32 / 16777216.0 });
        let p = m.pack(&params);
        for n in [8, 16] {
        let mut t = AlignedVec::zeros(m.rows() * TILE * n);
        let mut g = AlignedVec::zeros(m.rows() * TILE * n);
        for (i, v) in t.iter_mut().enumerate() { *v = (i % 7) as f32 * 0.1; }
        for (i, v) in g.iter_mut().enumerate() { *v = (i % 5) as f32 * 0.1; }
        let mut out = vec![0.0; m.parameters()];
        let mut best = [1e9; 3];
        for _ in 0..200 {
            let r = pulp::Arch::new().dispatch(K(&m, &p, &mut t, &mut g, n, &mut out));
            for k in 0..3 { best[k] = f64::min(best[k], r[k]); }
        }
        let fl = 2.0 * m.multiply_adds() as f64 * (n * TILE) as f64;
        println!("{widths:?} n={n} GFLOP/s fwd {:.0} bwd {:.0} dW {:.0}", fl / best[0] / 1e9, fl / best[1] / 1e9, fl / best[2] / 1e9);
        }
    }
}
