//! How well a track is located, against the frame alone, two simple filters, and the sequence matching of SeqSLAM, in
//! one run on drives through the town; on real traverses too, if there are any in `../shared/data` or
//! `WHEREABOUTS_DATA`. Then how long a step takes in a map of 100,000 images.
//!
//! `verdicts` compares tracks with and without the verdicts of `local` on a server instead, and `stored` times steps whose
//! track is stored (in the PostgreSQL of WHEREABOUTS_TEST_DATABASE_URL, if it is set).
//!
//! The arguments name the drives to run, by default all, and `kind=gem` the kind of descriptor, by default the model's.
//! `TRACK_TRACE=1` prints each answer. `tests/support/drives.rs` describes the other methods.

mod off;
mod robots;
mod sets;
mod verdicts;

use tokio::runtime::Runtime;
use whereabouts_core::{Descriptor, DescriptorKind, dot};
use whereabouts_index::SearchMode;
use whereabouts_testkit::drives;

use self::robots::{Located, Robots, Shared, step_at};
use self::sets::{Drive, Sets};
use self::verdicts::Localizer;

/// Images of the map in which a step is timed.
const LARGE: usize = 100_000;
/// Numbers in each of its descriptors.
const LARGE_DIM: usize = 512;
/// Timed steps.
const STEPS: usize = 300;

fn main() -> anyhow::Result<()> {
    let mut names: Vec<String> =
        std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let kind = names.iter().find_map(|name| name.strip_prefix("kind="));
    let kind: Option<DescriptorKind> = kind.map(str::parse).transpose()?;
    names.retain(|name| !name.starts_with("kind="));
    let runtime = Runtime::new()?;
    let sets = Sets::new(kind)?;
    let drives = [sets.all()?, off::all(&sets)?].concat();
    if let Some(at) = names.iter().position(|name| name == "verdicts") {
        names.remove(at);
        return runtime.block_on(verdicts_of(&sets, &names));
    }
    println!(
        "{:<34}{:>6}{:>6}{:>6}{:>8}{:>7}{:>9}   {}",
        "R@1 in percent",
        "alone",
        "A",
        "B",
        "SeqSLAM",
        "times",
        "odometry",
        Tally::HEADER
    );
    let (mut total, mut by_alone) = (Tally::default(), Tally::default());
    let is_named =
        |name: &str| names.is_empty() || names.iter().any(|wanted| name.contains(wanted.as_str()));
    for drive in drives.into_iter().filter(|drive| is_named(&drive.name)) {
        let others = Others::of(&drive);
        let mut tally = Tally::default();
        let mut ours = Vec::new();
        for with_odometry in [false, true] {
            let answers = runtime.block_on(follow(&drive, with_odometry))?;
            ours.push(drive.right(answers.iter().map(|answer| answer.image)));
            tally.add(&drive, &answers);
        }
        by_alone.add(&drive, &runtime.block_on(alone(&drive))?);
        println!(
            "{:<34}{:>6.1}{:>6.1}{:>6.1}{:>8.1}{:>7.1}{:>9.1}   {tally}",
            drive.name, others.alone, others.a, others.b, others.line, ours[0], ours[1]
        );
        total.merge(&tally);
    }
    println!("all drives, tracks: {total}");
    println!("{}", total.diagram());
    println!("all drives, frames alone with their calibrated confidence: {by_alone}");
    if is_named("large") {
        runtime.block_on(large())?;
    }
    if is_named("stored") {
        runtime.block_on(stored())?;
    }
    Ok(())
}

/// Drives with and without the verdicts of `local`.
async fn verdicts_of(sets: &Sets, names: &[String]) -> anyhow::Result<()> {
    let is_named =
        |name: &str| names.is_empty() || names.iter().any(|wanted| name.contains(wanted.as_str()));
    let drives = [sets.all()?, off::all(sets)?].concat();
    println!("{:<34}{:>8}{:>10}{:>10}{:>10}", "R@1", "times", "verdicts", "odometry", "verdicts");
    let (mut without, mut with) = (Tally::default(), Tally::default());
    for drive in drives.into_iter().filter(|drive| is_named(&drive.name)) {
        let localizer = Localizer::new(&drive, &sets.kind).await?;
        let mut shares = Vec::new();
        let mut own = (Tally::default(), Tally::default());
        for (with_odometry, with_verdicts) in
            [(false, false), (false, true), (true, false), (true, true)]
        {
            let answers = localizer.follow(&drive, (with_odometry, with_verdicts)).await?;
            shares.push(drive.right(answers.iter().map(|answer| answer.image)));
            let (tally, own) =
                if with_verdicts { (&mut with, &mut own.1) } else { (&mut without, &mut own.0) };
            tally.add(&drive, &answers);
            own.add(&drive, &answers);
        }
        println!(
            "{:<34}{:>8.1}{:>10.1}{:>10.1}{:>10.1}\n  without {}\n  with    {}",
            drive.name, shares[0], shares[1], shares[2], shares[3], own.0, own.1
        );
    }
    println!("{}\nall without {without}\nall with    {with}", Tally::HEADER);
    Ok(())
}

/// R@1 of the other methods.
struct Others {
    alone: f64,
    a: f64,
    b: f64,
    line: f64,
}

impl Others {
    fn of(drive: &Drive) -> Self {
        let row = |frame: &Descriptor| -> Vec<f32> {
            drive.map.iter().map(|(image, _)| dot(frame.as_slice(), image.as_slice())).collect()
        };
        let rows: Vec<Vec<f32>> = drive.frames.iter().map(|frame| row(&frame.descriptor)).collect();
        let right = |answers: Vec<usize>| drive.right(answers.into_iter().map(Some));
        Self {
            alone: right(drives::alone(&rows)),
            a: right(drives::with_odometry(&rows)),
            b: right(drives::without_odometry(&rows)),
            line: right(drives::best_line(&rows)),
        }
    }
}

/// Right and wrong answers by probability, in tenths, those that are known, and those off the map.
#[derive(Default)]
struct Tally {
    tenths: [[usize; 2]; 10],
    known: [usize; 2],
    /// Answers to frames off the map: all, those that are known, and those that say so.
    outside: [usize; 3],
}

impl Tally {
    const HEADER: &str = "≥ 0.9: right of   known: right wrong   off the map: of  known  told";

    fn add(&mut self, drive: &Drive, answers: &[Located]) {
        for (number, answer) in answers.iter().enumerate() {
            let right = usize::from(drive.is_right(number, answer.image));
            self.tenths[((answer.probability * 10.0) as usize).min(9)][right] += 1;
            self.known[right] += usize::from(answer.known);
            if !drive.is_on_map(number) {
                let is_told = answer.off_map >= 0.5;
                for (sum, is) in self.outside.iter_mut().zip([true, answer.known, is_told]) {
                    *sum += usize::from(is);
                }
            }
        }
    }

    fn merge(&mut self, other: &Self) {
        let tenths = self.tenths.iter_mut().zip(&other.tenths);
        for (sum, other) in tenths.chain([(&mut self.known, &other.known)]) {
            sum.iter_mut().zip(other).for_each(|(sum, other)| *sum += other);
        }
        self.outside.iter_mut().zip(other.outside).for_each(|(sum, other)| *sum += other);
    }

    /// The share of right answers for each tenth of probability.
    fn diagram(&self) -> String {
        let line = |(tenth, [wrong, right]): (usize, &[usize; 2])| {
            let answers = wrong + right;
            let share = 100.0 * *right as f64 / answers.max(1) as f64;
            format!("probability {:.1}: {share:5.1} % of {answers} right\n", tenth as f64 / 10.0)
        };
        self.tenths.iter().enumerate().map(line).collect()
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [wrong, right] = self.tenths[9];
        let sure = wrong + right;
        let share = 100.0 * right as f64 / sure.max(1) as f64;
        let [outside, known, told] = self.outside;
        write!(
            f,
            "{share:5.1} % of {sure:>5}   {:>6} {:>5}   {outside:>6} {known:>6} {told:>6}",
            self.known[1], self.known[0]
        )
    }
}

async fn follow(drive: &Drive, with_odometry: bool) -> anyhow::Result<Vec<Located>> {
    let robots = Robots::new(&drive.map).await?;
    let mut answers = Vec::new();
    for (number, frame) in drive.frames.iter().enumerate() {
        let step = step_at(frame.seconds, with_odometry.then_some(frame.moved_m))?;
        let located = robots.step(step, &frame.descriptor, SearchMode::Exact).await?.0;
        if std::env::var_os("TRACK_TRACE").is_some() {
            let (on, right) = (drive.is_on_map(number), drive.is_right(number, located.image));
            println!(
                "  {number:>4} {} {} p {:.3} off {:.3} image {:?}",
                if on { "on " } else { "OFF" },
                if right { "right" } else { "wrong" },
                located.probability,
                located.off_map,
                located.image
            );
        }
        answers.push(located);
    }
    Ok(answers)
}

/// The answers to the frames alone.
async fn alone(drive: &Drive) -> anyhow::Result<Vec<Located>> {
    let robots = Robots::new(&drive.map).await?;
    let mut answers = Vec::new();
    for frame in &drive.frames {
        answers.push(robots.alone(&frame.descriptor).await?);
    }
    Ok(answers)
}

/// Times steps in a large map: a robot that drives along it, and one that is lost.
async fn large() -> anyhow::Result<()> {
    let rows = sets::drawn(LARGE, LARGE_DIM)?;
    let robots = Robots::new(&rows).await?;
    for (name, stride) in [("that drives", 1), ("that is carried each time", 7919)] {
        for with_odometry in [true, false] {
            let mut times = Vec::new();
            for number in 0..STEPS {
                let place = (1000 + number * stride) % LARGE;
                let step = step_at(number as f64, with_odometry.then_some(1.0))?;
                let (_, ms) = robots.step(step, &rows[place].0, SearchMode::Exact).await?;
                times.push(ms);
            }
            // The first step reads the map.
            let mut times = times.split_off(1);
            times.sort_by(f64::total_cmp);
            let by = if with_odometry { "with odometry" } else { "without" };
            println!(
                "a step in a map of {LARGE} images of a robot {name}, {by}: median {:.2} ms, 95th percentile {:.2} ms",
                times[times.len() / 2],
                times[times.len() * 95 / 100]
            );
        }
    }
    Ok(())
}

/// Times steps whose track is stored before the answer, against those of a track in memory.
async fn stored() -> anyhow::Result<()> {
    let rows = sets::drawn(LARGE / 10, LARGE_DIM)?;
    let mut medians = Vec::new();
    for (name, shared) in [
        ("in memory", None),
        ("in a file of the data folder", Some(Shared::File)),
        ("in PostgreSQL", Some(Shared::Postgres)),
    ] {
        let Some(robots) = Robots::storing(&rows, shared).await? else {
            println!("PostgreSQL is left out: WHEREABOUTS_TEST_DATABASE_URL names none");
            continue;
        };
        let mut times = Vec::new();
        for number in 0..STEPS {
            let step = step_at(number as f64, Some(1.0))?;
            times.push(robots.step(step, &rows[1000 + number].0, SearchMode::Exact).await?.1);
        }
        let mut times = times.split_off(STEPS / 3);
        times.sort_by(f64::total_cmp);
        medians.push(times[times.len() / 2]);
        println!(
            "a step of a track {name}: median {:.2} ms, 95th percentile {:.2} ms, {:.2} x",
            times[times.len() / 2],
            times[times.len() * 95 / 100],
            times[times.len() / 2] / medians[0]
        );
    }
    Ok(())
}
