//! `whereabouts read`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::bail;
use serde_json::json;
use whereabouts_reading::{OnnxReader, Reader, ReaderSettings};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_vision::decode::decode;
use whereabouts_vision::{ImageLimits, Needed, threads_or_cores};

/// Read the text in pictures: signs, shop names, street names, door numbers
///
/// It runs here, without a server, with the reader that `make reader` installs. Each line is printed with the mean
/// probability of its characters, which is not calibrated, and where it begins in the picture.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Pictures: JPEG, PNG, WebP, TIFF, BMP, GIF or PNM
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Print a JSON object for each picture: its lines with all corners, as shares of width and height
    #[arg(long)]
    json: bool,
    /// Name of the reader, a folder in the assets
    #[arg(long, default_value = "ppocrv5")]
    reader: String,
    /// Most lines to read in a picture
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u16).range(1..))]
    max_lines: u16,
    /// Threads; 0 for as many as there are cores
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Folder with onnxruntime/ and models/ instead of the configured one
    #[arg(long, value_name = "DIR")]
    assets: Option<PathBuf>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let config = Config::load(None, &Overrides::default())?;
    let assets = config.model.installed_in(args.assets.as_deref().or(config.model.assets()));
    let settings = ReaderSettings {
        name: args.reader.clone(),
        threads: threads_or_cores(args.threads),
        max_lines: usize::from(args.max_lines),
    };
    let reader = OnnxReader::load(&assets, &settings)?;
    let limits = config.image.limits();
    let mut failed = 0;
    for file in &args.files {
        if let Err(error) = read(&reader, file, limits, args.json) {
            eprintln!("whereabouts: cannot read {}: {error:#}", file.display());
            failed += 1;
        }
    }
    match failed {
        0 => Ok(()),
        _ => bail!("{failed} of {} files could not be read; see above", args.files.len()),
    }
}

/// Reads one picture and prints its lines.
fn read(reader: &OnnxReader, file: &Path, limits: ImageLimits, json: bool) -> anyhow::Result<()> {
    let picture = decode(&std::fs::read(file)?, limits, Needed::All)?;
    let start = Instant::now();
    let lines = reader.read(&picture)?;
    let took_ms = start.elapsed().as_secs_f64() * 1e3;
    if json {
        let size = [picture.width, picture.height];
        println!("{}", json!({"file": file, "size": size, "took_ms": took_ms, "lines": lines}));
        return Ok(());
    }
    println!("{}: {} lines in {took_ms:.0} ms", file.display(), lines.len());
    for line in &lines {
        let [x, y] = line.corners[0];
        let (x, y) = (x * picture.width as f32, y * picture.height as f32);
        println!("  {:3.0} %  at {x:4.0}, {y:4.0}  {}", line.confidence * 100.0, line.text);
    }
    Ok(())
}
