//! Lets the linker leave the names open that the interpreter brings, on systems where it has to be told.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    pyo3_build_config::add_extension_module_link_args();
}
