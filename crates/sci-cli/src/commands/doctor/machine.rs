//! Processor, threads and memory.

use nets::kernels::Isa;
use serde_json::json;
use sysinfo::System;

use super::{Finding, told};
use crate::record::host;

/// The processor, the instruction sets that there are kernels for, and which of them are used.
pub(super) fn processor() -> Finding {
    let name = host::cpu();
    let sets: Vec<&str> = Isa::ALL.into_iter().filter(|isa| isa.available()).map(Isa::name).collect();
    let networks = match Isa::detect() {
        Ok(isa) => isa,
        Err(error) => return Finding::broken("processor", format!("{name}: {error}")),
    };
    let solvers = host::solver_kernel().name();
    let half = networks.half_precision();
    let precision = match half {
        "bf16" => "denoiser.precision = \"bf16\" halves the time of networks",
        "int16" => {
            "denoiser.precision = \"bf16\" is done with 16-bit integers, as there is no matrix unit (AMX) in use"
        }
        _ => "denoiser.precision = \"bf16\" is done in f32, as there is no matrix unit (AMX) in use",
    };
    let text = format!("{name}: networks use {}, solvers {solvers}; {precision}", networks.name());
    let details = json!({ "name": name, "kernels": sets, "networks": networks.name(), "solvers": solvers, "half_precision": half });
    Finding::fine("processor", text, details)
}

pub(super) fn threads() -> Finding {
    let used = rayon::current_num_threads();
    let cores = std::thread::available_parallelism().map_or(used, Into::into);
    let text = format!("{used} are used of {cores} that there are (--threads sets it)");
    Finding::fine("threads", text, json!({ "used": used, "available": cores }))
}

/// Memory, and what is left of it; a container's, where it has less.
pub(super) fn memory() -> Finding {
    let mut system = System::new();
    system.refresh_memory();
    let (mut total, mut available) = (system.total_memory(), system.available_memory());
    if let Some(limits) = system.cgroup_limits() {
        total = total.min(limits.total_memory);
        available = available.min(limits.free_memory);
    }
    if total == 0 {
        return Finding::missing("memory", "the system does not tell");
    }
    let text = format!("{}, {} of it available now; larger scenes: memory = \"…\"", told(total), told(available));
    Finding::fine("memory", text, json!({ "total_bytes": total, "available_bytes": available }))
}
