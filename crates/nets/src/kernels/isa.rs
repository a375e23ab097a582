//! The instruction sets that the kernels are compiled for, and which of them this machine has.

use super::error::KernelError;
use std::sync::OnceLock;

/// An instruction set that the kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isa {
    /// x86-64 with AMX for bf16: AVX-512F, but products of more than 16 input channels on the matrix unit, to 17 bits.
    Amx,
    /// x86-64 with AVX-512F: a vector is one register.
    Avx512,
    /// x86-64 with AVX2 and FMA: a vector is two registers.
    Avx2,
    /// AArch64: a vector is four registers.
    Neon,
    /// Plain Rust, for any machine; without fused multiply-add.
    Portable,
}

impl Isa {
    /// All of them, the fastest first.
    pub const ALL: [Self; 5] = [Self::Amx, Self::Avx512, Self::Avx2, Self::Neon, Self::Portable];

    /// The name that `SCI_KERNEL` knows it by.
    pub fn name(self) -> &'static str {
        match self {
            Self::Amx => "amx",
            Self::Avx512 => "avx512",
            Self::Avx2 => "avx2",
            Self::Neon => "neon",
            Self::Portable => "portable",
        }
    }

    /// Whether this machine has it.
    pub fn available(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Amx => matrix_unit(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => is_x86_feature_detected!("avx512f"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => std::arch::is_aarch64_feature_detected!("neon"),
            Self::Portable => true,
            #[allow(unreachable_patterns)]
            _ => false,
        }
    }

    /// The one to use: `SCI_KERNEL` if it is set, else the fastest that this machine has. Read once per process.
    ///
    /// # Errors
    /// [`KernelError::UnknownIsa`] or [`KernelError::MissingIsa`] when `SCI_KERNEL` asks for what there is not.
    pub fn detect() -> Result<Self, KernelError> {
        static CHOICE: OnceLock<Result<Isa, KernelError>> = OnceLock::new();
        CHOICE
            .get_or_init(|| match std::env::var("SCI_KERNEL") {
                Ok(name) => Self::named(&name),
                Err(std::env::VarError::NotPresent) => {
                    Ok(Self::ALL.into_iter().find(|isa| isa.available()).unwrap_or(Self::Portable))
                }
                Err(std::env::VarError::NotUnicode(name)) => {
                    Err(KernelError::UnknownIsa(name.to_string_lossy().into()))
                }
            })
            .clone()
    }

    /// The one to use where gradients are computed: as [`Isa::detect`], but for the matrix unit, which gains nothing there.
    ///
    /// # Errors
    /// As [`Isa::detect`].
    pub(super) fn detect_for_gradients() -> Result<Self, KernelError> {
        Self::detect().map(|isa| if isa == Self::Amx { Self::Avx512 } else { isa })
    }

    /// The instruction set of that name, if this machine has it.
    ///
    /// # Errors
    /// [`KernelError::UnknownIsa`] or [`KernelError::MissingIsa`].
    pub fn named(name: &str) -> Result<Self, KernelError> {
        let isa =
            Self::ALL.into_iter().find(|isa| isa.name() == name).ok_or_else(|| KernelError::UnknownIsa(name.into()))?;
        isa.checked()
    }

    /// Itself, if this machine has it.
    pub(super) fn checked(self) -> Result<Self, KernelError> {
        if self.available() { Ok(self) } else { Err(KernelError::MissingIsa(self.name())) }
    }

    /// What inference multiplies where 16-bit numbers are asked for ([`Precision::Bf16`](super::Precision::Bf16)): `bf16` on the matrix unit,
    /// `int16` where that is faster than f32; else nothing but `f32`.
    pub fn half_precision(self) -> &'static str {
        match self {
            Self::Amx => "bf16",
            _ if self.multiplies_integers() => "int16",
            _ => "f32",
        }
    }

    /// Whether more 16-bit integers are multiplied in a second than f32 numbers. On AArch64 they are as many.
    pub(super) fn multiplies_integers(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => is_x86_feature_detected!("avx512vnni"),
            Self::Avx2 => true,
            _ => false,
        }
    }

    /// Vectors of output channels that one register tile holds (`Simd::VECS`).
    pub(super) fn vecs(self) -> usize {
        if matches!(self, Self::Amx | Self::Avx512) { 2 } else { 1 }
    }
}

/// Whether processor and system have the matrix unit; asks the system for its use, once.
#[cfg(target_arch = "x86_64")]
fn matrix_unit() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| {
        const BF16_AND_TILES: u32 = 1 << 22 | 1 << 24;
        is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16")
            && std::arch::x86_64::__cpuid_count(7, 0).edx & BF16_AND_TILES == BF16_AND_TILES
            && permitted()
    })
}

/// Linux saves the tiles of a process only if it asks.
#[cfg(target_arch = "x86_64")]
fn permitted() -> bool {
    #[cfg(target_os = "linux")]
    {
        const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
        const TILE_DATA: libc::c_long = 18;
        // SAFETY: the call reads no memory.
        unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA) == 0 }
    }
    #[cfg(not(target_os = "linux"))]
    false
}
