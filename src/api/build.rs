//! Compiles the gRPC contract, without a protoc on the machine.

#[cfg(feature = "grpc")]
const CONTRACT: [&str; 4] = ["types", "job", "localization", "map"];

#[cfg(not(feature = "grpc"))]
fn main() {
    println!("cargo::rerun-if-changed=build.rs");
}

#[cfg(feature = "grpc")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    use prost::Message as _;

    println!("cargo::rerun-if-changed=../../proto");
    let files = CONTRACT.map(|name| format!("../../proto/whereabouts/v1/{name}.proto"));
    let mut compiler = protox::Compiler::new(["../../proto"])?;
    compiler.include_imports(true).include_source_info(true).open_files(files)?;
    tonic_prost_build::configure()
        .build_client(false)
        .build_transport(false)
        .bytes(".whereabouts.v1")
        .compile_fds(compiler.file_descriptor_set())?;
    // Reflection serves the descriptors without the comments of the source.
    let mut descriptors = compiler.file_descriptor_set();
    descriptors.file.iter_mut().for_each(|file| file.source_code_info = None);
    let out = std::path::PathBuf::from(std::env::var("OUT_DIR")?).join("whereabouts.v1.bin");
    Ok(std::fs::write(out, descriptors.encode_to_vec())?)
}
