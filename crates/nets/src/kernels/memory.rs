//! What the system's allocator does with large tensors.

/// Tells glibc's allocator to keep freed memory instead of giving it back to the system.
///
/// candle allocates every tensor anew. From 32 MB on glibc maps each of them freshly, and the first touch of its pages
/// then costs as much as the convolution that fills them. Programs that make such tensors in a loop call this once when
/// they start. Elsewhere than on Linux with glibc it does nothing. The process keeps its peak memory until it ends.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: mallopt only changes settings of the allocator, under its own lock.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, libc::c_int::MAX);
        // one heap, or each thread would keep its own share of freed tensors
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

/// Gives memory that was freed back to the system, after work whose many small tensors nothing like them follows: glibc's allocator would keep
/// it. Elsewhere than on Linux with glibc it does nothing.
pub fn release_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: malloc_trim only touches the allocator's free pages, under its own locks.
    unsafe {
        libc::malloc_trim(0);
    }
}
