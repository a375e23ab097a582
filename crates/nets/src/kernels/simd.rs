//! Sixteen f32 lanes on each instruction set.
//!
//! Every kernel is written once over [`Simd`]. The bodies are `#[inline(always)]`, so that they take on the target
//! features of the entry point that [`entry!`](super::entry) makes for each instruction set. Closures and iterator
//! adaptors are avoided in them: those would be compiled without the features.

/// Lanes in a vector, and channels in a block of the blocked layout.
pub const LANES: usize = 16;

/// A vector of [`LANES`] f32 numbers.
///
/// # Safety
/// Every method needs the instruction set of the implementing type; the memory methods read or write 16 floats.
pub(super) trait Simd: Copy {
    /// Output vectors per register tile.
    const VECS: usize;
    /// Most pixels (or Winograd tiles) per register tile: `ROWS · VECS` accumulators fit the register file.
    const ROWS: usize;
    /// Input channels per register tile of the weight gradient.
    const GRAD_ROWS: usize;

    unsafe fn splat(x: f32) -> Self;
    unsafe fn load(p: *const f32) -> Self;
    unsafe fn store(self, p: *mut f32);
    unsafe fn add(self, o: Self) -> Self;
    unsafe fn sub(self, o: Self) -> Self;
    unsafe fn mul(self, o: Self) -> Self;
    /// `self · a + b`, fused where the hardware does so.
    unsafe fn fma(self, a: Self, b: Self) -> Self;
    /// `max(self, floor)`; a NaN in `self` stays.
    unsafe fn at_least(self, floor: Self) -> Self;

    /// `dst[j·dst_step + i] = src[i·src_step + j]` for `i, j` in `0..16`.
    #[inline(always)]
    unsafe fn transpose(src: *const f32, src_step: usize, dst: *mut f32, dst_step: usize) {
        for i in 0..LANES {
            for j in 0..LANES {
                // SAFETY: the caller gives two blocks of 16 rows of 16.
                unsafe { *dst.add(j * dst_step + i) = *src.add(i * src_step + j) }
            }
        }
    }

    /// Asks for the cache line of `p` early; `p` need not be valid.
    #[inline(always)]
    unsafe fn prefetch(_p: *const f32) {}
}

/// Products of 16-bit integers, two channels at a time.
///
/// # Safety
/// As of [`Simd`], and the instruction set must have them ([`Isa::multiplies_integers`](super::isa::Isa::multiplies_integers)).
#[cfg(target_arch = "x86_64")]
pub(super) trait Pairs: Simd {
    /// [`LANES`] i32 numbers, or as many pairs of i16.
    type Sums: Copy;
    /// Zeros.
    const NO_SUMS: Self::Sums;

    /// The pair at `p` in all lanes.
    unsafe fn splat_pair(p: *const i16) -> Self::Sums;
    /// As many pairs as there are lanes.
    unsafe fn load_pairs(p: *const i16) -> Self::Sums;
    /// `sums + a₀·b₀ + a₁·b₁`, lane by lane.
    unsafe fn add_products(a: Self::Sums, b: Self::Sums, sums: Self::Sums) -> Self::Sums;
    unsafe fn to_single(sums: Self::Sums) -> Self;
    /// Writes 16 i16 numbers: those nearest, the even one of two.
    unsafe fn store_rounded(self, p: *mut i16);
    /// The larger of these bits of self and `so_far`, which are f32 numbers of no sign by their bits; what is not finite is larger than all that is.
    unsafe fn larger(self, bits: Self::Sums, so_far: Self::Sums) -> Self::Sums;
    /// The largest of f32 numbers given by their bits.
    unsafe fn largest(magnitudes: Self::Sums) -> f32;
}

#[derive(Clone, Copy)]
#[repr(align(64))]
pub(super) struct Portable([f32; LANES]);

macro_rules! lanewise {
    (|$i:ident| $e:expr) => {{
        let mut r = [0f32; LANES];
        let mut $i = 0;
        while $i < LANES {
            r[$i] = $e;
            $i += 1;
        }
        Portable(r)
    }};
}

impl Simd for Portable {
    const VECS: usize = 1;
    const ROWS: usize = 2;
    const GRAD_ROWS: usize = 2;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        Self([x; LANES])
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        // SAFETY: the caller gives 16 readable floats; f32 and [f32; 16] need the same alignment.
        Self(unsafe { *p.cast::<[f32; LANES]>() })
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        // SAFETY: the caller gives 16 writable floats.
        unsafe { *p.cast::<[f32; LANES]>() = self.0 }
    }
    #[inline(always)]
    unsafe fn add(self, o: Self) -> Self {
        lanewise!(|i| self.0[i] + o.0[i])
    }
    #[inline(always)]
    unsafe fn sub(self, o: Self) -> Self {
        lanewise!(|i| self.0[i] - o.0[i])
    }
    #[inline(always)]
    unsafe fn mul(self, o: Self) -> Self {
        lanewise!(|i| self.0[i] * o.0[i])
    }
    #[inline(always)]
    unsafe fn fma(self, a: Self, b: Self) -> Self {
        lanewise!(|i| self.0[i] * a.0[i] + b.0[i])
    }
    #[inline(always)]
    unsafe fn at_least(self, floor: Self) -> Self {
        lanewise!(|i| if self.0[i] < floor.0[i] { floor.0[i] } else { self.0[i] })
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{LANES, Pairs, Simd};
    use std::arch::x86_64::*;

    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx512(__m512);

    // SAFETY (all methods): the trait's contract: the caller has AVX-512F and gives valid memory.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Simd for Avx512 {
        const VECS: usize = 2;
        const ROWS: usize = 14;
        const GRAD_ROWS: usize = 8;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            Self(unsafe { _mm512_set1_ps(x) })
        }
        #[inline(always)]
        unsafe fn load(p: *const f32) -> Self {
            Self(unsafe { _mm512_loadu_ps(p) })
        }
        #[inline(always)]
        unsafe fn store(self, p: *mut f32) {
            unsafe { _mm512_storeu_ps(p, self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, o: Self) -> Self {
            Self(unsafe { _mm512_add_ps(self.0, o.0) })
        }
        #[inline(always)]
        unsafe fn sub(self, o: Self) -> Self {
            Self(unsafe { _mm512_sub_ps(self.0, o.0) })
        }
        #[inline(always)]
        unsafe fn mul(self, o: Self) -> Self {
            Self(unsafe { _mm512_mul_ps(self.0, o.0) })
        }
        #[inline(always)]
        unsafe fn fma(self, a: Self, b: Self) -> Self {
            Self(unsafe { _mm512_fmadd_ps(self.0, a.0, b.0) })
        }
        #[inline(always)]
        unsafe fn at_least(self, floor: Self) -> Self {
            // MAXPS gives its second operand when one is NaN
            Self(unsafe { _mm512_max_ps(floor.0, self.0) })
        }
        #[inline(always)]
        unsafe fn prefetch(p: *const f32) {
            unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
        }
        /// Rows are loaded as quarters, so that lane-crossing is done by loads and only 4×4 transposes are left.
        #[inline(always)]
        unsafe fn transpose(src: *const f32, src_step: usize, dst: *mut f32, dst_step: usize) {
            unsafe {
                let mut q = 0;
                while q < 4 {
                    // row k of this quarter: source rows k, k+4, k+8, k+12, columns 4q..4q+4
                    let mut r = [_mm512_setzero_ps(); 4];
                    let mut k = 0;
                    while k < 4 {
                        let p = src.add(k * src_step + 4 * q);
                        let v = _mm512_castps128_ps512(_mm_loadu_ps(p));
                        let v = _mm512_insertf32x4::<1>(v, _mm_loadu_ps(p.add(4 * src_step)));
                        let v = _mm512_insertf32x4::<2>(v, _mm_loadu_ps(p.add(8 * src_step)));
                        r[k] = _mm512_insertf32x4::<3>(v, _mm_loadu_ps(p.add(12 * src_step)));
                        k += 1;
                    }
                    let (a, b) = (_mm512_unpacklo_ps(r[0], r[1]), _mm512_unpackhi_ps(r[0], r[1]));
                    let (c, d) = (_mm512_unpacklo_ps(r[2], r[3]), _mm512_unpackhi_ps(r[2], r[3]));
                    let out = dst.add(4 * q * dst_step);
                    _mm512_storeu_ps(out, _mm512_shuffle_ps::<0x44>(a, c));
                    _mm512_storeu_ps(out.add(dst_step), _mm512_shuffle_ps::<0xEE>(a, c));
                    _mm512_storeu_ps(out.add(2 * dst_step), _mm512_shuffle_ps::<0x44>(b, d));
                    _mm512_storeu_ps(out.add(3 * dst_step), _mm512_shuffle_ps::<0xEE>(b, d));
                    q += 1;
                }
            }
        }
    }

    /// The largest of these bits.
    #[inline(always)]
    fn largest(bits: [i32; LANES]) -> f32 {
        let (mut most, mut i) = (0, 0);
        while i < LANES {
            most = if bits[i] > most { bits[i] } else { most };
            i += 1;
        }
        f32::from_bits(most as u32)
    }

    // SAFETY (all methods): the trait's contract: the caller has AVX-512F and VNNI, and gives valid memory.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Pairs for Avx512 {
        type Sums = __m512i;
        const NO_SUMS: __m512i = unsafe { std::mem::zeroed() };

        #[inline(always)]
        unsafe fn splat_pair(p: *const i16) -> __m512i {
            unsafe { _mm512_set1_epi32(p.cast::<i32>().read_unaligned()) }
        }
        #[inline(always)]
        unsafe fn load_pairs(p: *const i16) -> __m512i {
            unsafe { _mm512_loadu_si512(p.cast()) }
        }
        #[inline(always)]
        unsafe fn add_products(a: __m512i, b: __m512i, sums: __m512i) -> __m512i {
            unsafe { _mm512_dpwssd_epi32(sums, a, b) }
        }
        #[inline(always)]
        unsafe fn to_single(sums: __m512i) -> Self {
            Self(unsafe { _mm512_cvtepi32_ps(sums) })
        }
        #[inline(always)]
        unsafe fn store_rounded(self, p: *mut i16) {
            unsafe { _mm256_storeu_si256(p.cast(), _mm512_cvtsepi32_epi16(_mm512_cvtps_epi32(self.0))) }
        }
        #[inline(always)]
        unsafe fn larger(self, bits: __m512i, so_far: __m512i) -> __m512i {
            unsafe { _mm512_max_epi32(so_far, _mm512_and_si512(bits, _mm512_castps_si512(self.0))) }
        }
        #[inline(always)]
        unsafe fn largest(magnitudes: __m512i) -> f32 {
            largest(unsafe { std::mem::transmute::<__m512i, [i32; LANES]>(magnitudes) })
        }
    }

    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx2(__m256, __m256);

    // SAFETY (all methods): the trait's contract: the caller has AVX2, and gives valid memory.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Pairs for Avx2 {
        type Sums = [__m256i; 2];
        const NO_SUMS: [__m256i; 2] = unsafe { std::mem::zeroed() };

        #[inline(always)]
        unsafe fn splat_pair(p: *const i16) -> Self::Sums {
            unsafe { [_mm256_set1_epi32(p.cast::<i32>().read_unaligned()); 2] }
        }
        #[inline(always)]
        unsafe fn load_pairs(p: *const i16) -> Self::Sums {
            unsafe { [_mm256_loadu_si256(p.cast()), _mm256_loadu_si256(p.add(LANES).cast())] }
        }
        #[inline(always)]
        unsafe fn add_products(a: Self::Sums, b: Self::Sums, sums: Self::Sums) -> Self::Sums {
            unsafe {
                [
                    _mm256_add_epi32(sums[0], _mm256_madd_epi16(a[0], b[0])),
                    _mm256_add_epi32(sums[1], _mm256_madd_epi16(a[1], b[1])),
                ]
            }
        }
        #[inline(always)]
        unsafe fn to_single(sums: Self::Sums) -> Self {
            unsafe { Self(_mm256_cvtepi32_ps(sums[0]), _mm256_cvtepi32_ps(sums[1])) }
        }
        #[inline(always)]
        unsafe fn store_rounded(self, p: *mut i16) {
            unsafe {
                let packed = _mm256_packs_epi32(_mm256_cvtps_epi32(self.0), _mm256_cvtps_epi32(self.1));
                // The instruction packs each half of the registers apart.
                _mm256_storeu_si256(p.cast(), _mm256_permute4x64_epi64::<0b11_01_10_00>(packed));
            }
        }
        #[inline(always)]
        unsafe fn larger(self, bits: Self::Sums, so_far: Self::Sums) -> Self::Sums {
            unsafe {
                [
                    _mm256_max_epi32(so_far[0], _mm256_and_si256(bits[0], _mm256_castps_si256(self.0))),
                    _mm256_max_epi32(so_far[1], _mm256_and_si256(bits[1], _mm256_castps_si256(self.1))),
                ]
            }
        }
        #[inline(always)]
        unsafe fn largest(magnitudes: Self::Sums) -> f32 {
            largest(unsafe { std::mem::transmute::<[__m256i; 2], [i32; LANES]>(magnitudes) })
        }
    }

    // SAFETY (all methods): the trait's contract: the caller has AVX2 and FMA and gives valid memory.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Simd for Avx2 {
        const VECS: usize = 1;
        const ROWS: usize = 6;
        const GRAD_ROWS: usize = 4;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            unsafe { Self(_mm256_set1_ps(x), _mm256_set1_ps(x)) }
        }
        #[inline(always)]
        unsafe fn load(p: *const f32) -> Self {
            unsafe { Self(_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))) }
        }
        #[inline(always)]
        unsafe fn store(self, p: *mut f32) {
            unsafe {
                _mm256_storeu_ps(p, self.0);
                _mm256_storeu_ps(p.add(8), self.1);
            }
        }
        #[inline(always)]
        unsafe fn add(self, o: Self) -> Self {
            unsafe { Self(_mm256_add_ps(self.0, o.0), _mm256_add_ps(self.1, o.1)) }
        }
        #[inline(always)]
        unsafe fn sub(self, o: Self) -> Self {
            unsafe { Self(_mm256_sub_ps(self.0, o.0), _mm256_sub_ps(self.1, o.1)) }
        }
        #[inline(always)]
        unsafe fn mul(self, o: Self) -> Self {
            unsafe { Self(_mm256_mul_ps(self.0, o.0), _mm256_mul_ps(self.1, o.1)) }
        }
        #[inline(always)]
        unsafe fn fma(self, a: Self, b: Self) -> Self {
            unsafe { Self(_mm256_fmadd_ps(self.0, a.0, b.0), _mm256_fmadd_ps(self.1, a.1, b.1)) }
        }
        #[inline(always)]
        unsafe fn at_least(self, floor: Self) -> Self {
            unsafe { Self(_mm256_max_ps(floor.0, self.0), _mm256_max_ps(floor.1, self.1)) }
        }
        #[inline(always)]
        unsafe fn prefetch(p: *const f32) {
            unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
        }
        /// Four 8×8 transposes; as for AVX-512, halves are put together by loads.
        #[inline(always)]
        unsafe fn transpose(src: *const f32, src_step: usize, dst: *mut f32, dst_step: usize) {
            unsafe {
                let mut quarter = 0;
                while quarter < 8 {
                    // columns 4·(quarter/2).., source rows 8·(quarter%2)..
                    let (col, row) = (4 * (quarter / 2), 8 * (quarter % 2));
                    let mut r = [_mm256_setzero_ps(); 4];
                    let mut k = 0;
                    while k < 4 {
                        let p = src.add((row + k) * src_step + col);
                        let v = _mm256_castps128_ps256(_mm_loadu_ps(p));
                        r[k] = _mm256_insertf128_ps::<1>(v, _mm_loadu_ps(p.add(4 * src_step)));
                        k += 1;
                    }
                    let (a, b) = (_mm256_unpacklo_ps(r[0], r[1]), _mm256_unpackhi_ps(r[0], r[1]));
                    let (c, d) = (_mm256_unpacklo_ps(r[2], r[3]), _mm256_unpackhi_ps(r[2], r[3]));
                    let out = dst.add(col * dst_step + row);
                    _mm256_storeu_ps(out, _mm256_shuffle_ps::<0x44>(a, c));
                    _mm256_storeu_ps(out.add(dst_step), _mm256_shuffle_ps::<0xEE>(a, c));
                    _mm256_storeu_ps(out.add(2 * dst_step), _mm256_shuffle_ps::<0x44>(b, d));
                    _mm256_storeu_ps(out.add(3 * dst_step), _mm256_shuffle_ps::<0xEE>(b, d));
                    quarter += 1;
                }
            }
        }
    }
}

#[cfg(target_arch = "aarch64")]
pub(super) use arm::Neon;

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::Simd;
    use std::arch::aarch64::*;

    #[derive(Clone, Copy)]
    pub(in super::super) struct Neon([float32x4_t; 4]);

    macro_rules! quarters {
        ($f:ident($($x:expr),*)) => { Neon([$f($($x[0]),*), $f($($x[1]),*), $f($($x[2]),*), $f($($x[3]),*)]) };
    }

    // SAFETY (all methods): the trait's contract: the caller has NEON and gives valid memory.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Simd for Neon {
        const VECS: usize = 1;
        const ROWS: usize = 6;
        const GRAD_ROWS: usize = 4;

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            Self(unsafe { [vdupq_n_f32(x); 4] })
        }
        #[inline(always)]
        unsafe fn load(p: *const f32) -> Self {
            unsafe { Self([vld1q_f32(p), vld1q_f32(p.add(4)), vld1q_f32(p.add(8)), vld1q_f32(p.add(12))]) }
        }
        #[inline(always)]
        unsafe fn store(self, p: *mut f32) {
            unsafe {
                vst1q_f32(p, self.0[0]);
                vst1q_f32(p.add(4), self.0[1]);
                vst1q_f32(p.add(8), self.0[2]);
                vst1q_f32(p.add(12), self.0[3]);
            }
        }
        #[inline(always)]
        unsafe fn add(self, o: Self) -> Self {
            unsafe { quarters!(vaddq_f32(self.0, o.0)) }
        }
        #[inline(always)]
        unsafe fn sub(self, o: Self) -> Self {
            unsafe { quarters!(vsubq_f32(self.0, o.0)) }
        }
        #[inline(always)]
        unsafe fn mul(self, o: Self) -> Self {
            unsafe { quarters!(vmulq_f32(self.0, o.0)) }
        }
        #[inline(always)]
        unsafe fn fma(self, a: Self, b: Self) -> Self {
            // vfmaq(b, x, y) = b + x·y
            unsafe { quarters!(vfmaq_f32(b.0, self.0, a.0)) }
        }
        #[inline(always)]
        unsafe fn at_least(self, floor: Self) -> Self {
            // FMAX gives NaN when one operand is NaN
            unsafe { quarters!(vmaxq_f32(self.0, floor.0)) }
        }
    }
}

/// `entry!(fn name = body(arg: Type, ..))` makes `unsafe fn name(isa, arg, ..)`, which runs `body::<S>(arg, ..)` in
/// code compiled for `isa`.
///
/// Its safety contract: that of `body`, and `isa.available()`.
macro_rules! entry {
    ($vis:vis fn $name:ident = $body:ident($($arg:ident: $ty:ty),* $(,)?)) => {
        $vis unsafe fn $name(isa: $crate::kernels::isa::Isa, $($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f")]
            unsafe fn avx512($($arg: $ty),*) {
                // SAFETY: the features of this function, and the caller's contract.
                unsafe { $body::<$crate::kernels::simd::Avx512>($($arg),*) }
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            unsafe fn avx2($($arg: $ty),*) {
                // SAFETY: as above.
                unsafe { $body::<$crate::kernels::simd::Avx2>($($arg),*) }
            }
            #[cfg(target_arch = "aarch64")]
            #[target_feature(enable = "neon")]
            unsafe fn neon($($arg: $ty),*) {
                // SAFETY: as above.
                unsafe { $body::<$crate::kernels::simd::Neon>($($arg),*) }
            }
            // SAFETY: `isa` is available, which is the caller's promise, so its features are there.
            unsafe {
                match isa {
                    #[cfg(target_arch = "x86_64")]
                    $crate::kernels::isa::Isa::Amx | $crate::kernels::isa::Isa::Avx512 => avx512($($arg),*),
                    #[cfg(target_arch = "x86_64")]
                    $crate::kernels::isa::Isa::Avx2 => avx2($($arg),*),
                    #[cfg(target_arch = "aarch64")]
                    $crate::kernels::isa::Isa::Neon => neon($($arg),*),
                    _ => $body::<$crate::kernels::simd::Portable>($($arg),*),
                }
            }
        }
    };
}
pub(super) use entry;
