//! Tests that run once, against the embedded store: they are about the data folder, or about what no store
//! changes (models, evaluation, admission control). `tests/scale_out.sh` leaves out every module of this name;
//! a single test of this kind sits in a `mod embedded_only` of its own file.

mod demo;
mod dinov2;
mod doctor;
mod documented;
mod eval;
mod input_size;
mod model_files;
mod models;
mod needs_openvino;
mod needs_photographs;
mod odd_models;
mod overload;
mod schema;
