//! The few vector operations that the TV kernel needs, on each instruction set.
//!
//! Square root and reciprocal go through the hardware's estimates and one Newton step (relative errors under 1e-6),
//! at a tenth of the cost of the exact instructions. A vector is wide enough that two of them are in flight at a time.

/// A vector of [`Lanes::N`] numbers.
///
/// # Safety
/// Every method needs the instruction set of the implementing type; `load` and `store` move `N` floats.
pub(crate) trait Lanes: Copy {
    /// Numbers in a vector, at most [`MAX_LANES`].
    const N: usize;
    unsafe fn splat(v: f32) -> Self;
    unsafe fn load(p: *const f32) -> Self;
    unsafe fn store(self, p: *mut f32);
    unsafe fn add(self, o: Self) -> Self;
    unsafe fn sub(self, o: Self) -> Self;
    unsafe fn mul(self, o: Self) -> Self;
    /// `self · a + b`.
    unsafe fn mul_add(self, a: Self, b: Self) -> Self;
    /// `b − self · a`.
    unsafe fn neg_mul_add(self, a: Self, b: Self) -> Self;
    /// `√self` for `self ≥ 0`; a zero gives at most 1e-15.
    unsafe fn sqrt(self) -> Self;
    /// `1 / self` for `self ≥ 1`.
    unsafe fn recip(self) -> Self;
}

/// The widest vector.
pub(crate) const MAX_LANES: usize = 32;

/// One number at a time, for rows that are narrower than a vector.
// SAFETY (of every block below): the trait's contract gives the memory.
#[allow(clippy::undocumented_unsafe_blocks)]
impl Lanes for f32 {
    const N: usize = 1;
    #[inline(always)]
    unsafe fn splat(v: f32) -> Self {
        v
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        unsafe { *p }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        unsafe { *p = self }
    }
    #[inline(always)]
    unsafe fn add(self, o: Self) -> Self {
        self + o
    }
    #[inline(always)]
    unsafe fn sub(self, o: Self) -> Self {
        self - o
    }
    #[inline(always)]
    unsafe fn mul(self, o: Self) -> Self {
        self * o
    }
    #[inline(always)]
    unsafe fn mul_add(self, a: Self, b: Self) -> Self {
        self * a + b
    }
    #[inline(always)]
    unsafe fn neg_mul_add(self, a: Self, b: Self) -> Self {
        b - self * a
    }
    #[inline(always)]
    unsafe fn sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    unsafe fn recip(self) -> Self {
        1.0 / self
    }
}
/// Below it `1/√` would leave the range of `f32`.
#[cfg(target_arch = "x86_64")]
const TINY: f32 = 1e-30;

#[derive(Clone, Copy)]
pub(crate) struct Portable([f32; 16]);

impl Portable {
    #[inline(always)]
    fn map(f: impl Fn(usize) -> f32) -> Self {
        Self(std::array::from_fn(f))
    }
}

impl Lanes for Portable {
    const N: usize = 16;
    #[inline(always)]
    unsafe fn splat(v: f32) -> Self {
        Self([v; 16])
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        // SAFETY: the caller gives 16 readable floats; arrays are aligned as their elements.
        Self(unsafe { *p.cast() })
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        // SAFETY: the caller gives 16 writable floats.
        unsafe { *p.cast() = self.0 }
    }
    #[inline(always)]
    unsafe fn add(self, o: Self) -> Self {
        Self::map(|i| self.0[i] + o.0[i])
    }
    #[inline(always)]
    unsafe fn sub(self, o: Self) -> Self {
        Self::map(|i| self.0[i] - o.0[i])
    }
    #[inline(always)]
    unsafe fn mul(self, o: Self) -> Self {
        Self::map(|i| self.0[i] * o.0[i])
    }
    #[inline(always)]
    unsafe fn mul_add(self, a: Self, b: Self) -> Self {
        Self::map(|i| self.0[i] * a.0[i] + b.0[i])
    }
    #[inline(always)]
    unsafe fn neg_mul_add(self, a: Self, b: Self) -> Self {
        Self::map(|i| b.0[i] - self.0[i] * a.0[i])
    }
    #[inline(always)]
    unsafe fn sqrt(self) -> Self {
        Self::map(|i| self.0[i].sqrt())
    }
    #[inline(always)]
    unsafe fn recip(self) -> Self {
        Self::map(|i| 1.0 / self.0[i])
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Lanes, TINY};
    use std::arch::x86_64::*;

    /// Implements [`Lanes`] for two registers side by side.
    macro_rules! lanes {
        ($name:ident, $register:ty, $n:expr, $set1:ident, $load:ident, $store:ident, $add:ident, $sub:ident, $mul:ident,
         $fma:ident, $fnma:ident, $max:ident, $rsqrt:ident, $rcp:ident) => {
            #[derive(Clone, Copy)]
            pub(crate) struct $name([$register; 2]);

            // SAFETY (of every block below): the trait's contract gives the instruction set and the memory.
            #[allow(clippy::undocumented_unsafe_blocks)]
            impl Lanes for $name {
                const N: usize = 2 * $n;
                #[inline(always)]
                unsafe fn splat(v: f32) -> Self {
                    unsafe { Self([$set1(v); 2]) }
                }
                #[inline(always)]
                unsafe fn load(p: *const f32) -> Self {
                    unsafe { Self([$load(p), $load(p.add($n))]) }
                }
                #[inline(always)]
                unsafe fn store(self, p: *mut f32) {
                    unsafe {
                        $store(p, self.0[0]);
                        $store(p.add($n), self.0[1]);
                    }
                }
                #[inline(always)]
                unsafe fn add(self, o: Self) -> Self {
                    unsafe { Self([$add(self.0[0], o.0[0]), $add(self.0[1], o.0[1])]) }
                }
                #[inline(always)]
                unsafe fn sub(self, o: Self) -> Self {
                    unsafe { Self([$sub(self.0[0], o.0[0]), $sub(self.0[1], o.0[1])]) }
                }
                #[inline(always)]
                unsafe fn mul(self, o: Self) -> Self {
                    unsafe { Self([$mul(self.0[0], o.0[0]), $mul(self.0[1], o.0[1])]) }
                }
                #[inline(always)]
                unsafe fn mul_add(self, a: Self, b: Self) -> Self {
                    unsafe { Self([$fma(self.0[0], a.0[0], b.0[0]), $fma(self.0[1], a.0[1], b.0[1])]) }
                }
                #[inline(always)]
                unsafe fn neg_mul_add(self, a: Self, b: Self) -> Self {
                    unsafe { Self([$fnma(self.0[0], a.0[0], b.0[0]), $fnma(self.0[1], a.0[1], b.0[1])]) }
                }
                #[inline(always)]
                unsafe fn sqrt(self) -> Self {
                    unsafe {
                        let tiny = $set1(TINY);
                        let s = Self([$max(self.0[0], tiny), $max(self.0[1], tiny)]);
                        let y = Self([$rsqrt(s.0[0]), $rsqrt(s.0[1])]);
                        // With n ≈ √s and e = 1 − s y²: √s = n + n e / 2.
                        let n = s.mul(y);
                        let e = n.neg_mul_add(y, Self::splat(1.0));
                        n.mul(Self::splat(0.5)).mul_add(e, n)
                    }
                }
                #[inline(always)]
                unsafe fn recip(self) -> Self {
                    unsafe {
                        let r = Self([$rcp(self.0[0]), $rcp(self.0[1])]);
                        let e = self.neg_mul_add(r, Self::splat(1.0));
                        r.mul_add(e, r)
                    }
                }
            }
        };
    }

    lanes!(
        Avx512,
        __m512,
        16,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_add_ps,
        _mm512_sub_ps,
        _mm512_mul_ps,
        _mm512_fmadd_ps,
        _mm512_fnmadd_ps,
        _mm512_max_ps,
        _mm512_rsqrt14_ps,
        _mm512_rcp14_ps
    );
    lanes!(
        Avx2,
        __m256,
        8,
        _mm256_set1_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        _mm256_add_ps,
        _mm256_sub_ps,
        _mm256_mul_ps,
        _mm256_fmadd_ps,
        _mm256_fnmadd_ps,
        _mm256_max_ps,
        _mm256_rsqrt_ps,
        _mm256_rcp_ps
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The worst relative errors of `√` and `1/` over many magnitudes, and `√0`.
    fn errors<L: Lanes>() -> [f32; 3] {
        let (mut root, mut inverse) = (0f32, 0f32);
        let mut out = [0f32; MAX_LANES];
        for k in -80..80 {
            let s = 1.37f32 * 2f32.powi(k);
            // SAFETY: the caller has checked the instruction set; `out` holds the widest vector.
            unsafe {
                L::splat(s).sqrt().store(out.as_mut_ptr());
                root = root.max((out[L::N - 1] / s.sqrt() - 1.0).abs());
                L::splat(1.0 + s).recip().store(out.as_mut_ptr());
                inverse = inverse.max((out[0] * (1.0 + s) - 1.0).abs());
            }
        }
        // SAFETY: as above.
        unsafe { L::splat(0.0).sqrt().store(out.as_mut_ptr()) };
        [root, inverse, out[0]]
    }

    fn check(errors: [f32; 3]) {
        assert!(errors[0] < 1e-6 && errors[1] < 1e-6 && errors[2] <= 1e-15, "{errors:?}");
    }

    #[test]
    fn estimates_reach_the_stated_errors() {
        check(errors::<f32>());
        check(errors::<Portable>());
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                check(errors::<Avx2>());
            }
            if is_x86_feature_detected!("avx512f") {
                check(errors::<Avx512>());
            }
        }
    }
}
