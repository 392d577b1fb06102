//! Drives that leave the map: past the end of a road, through streets that the map lacks, into another town, and back.

use super::sets::{Drive, Frame, Sets, TownSet, Traverse};

/// Places in a street of the town.
const STREET: usize = 8;

/// All drives that leave the map.
pub fn all(sets: &Sets) -> anyhow::Result<Vec<Drive>> {
    let mut drives = Vec::new();
    let elsewhere = &sets.towns[2];
    for town in &sets.towns[..2] {
        let count = town.map.len();
        drives.push(town.drive(", past the end", &|place| place < count / 2, count / 4..count));
        let is_street = |place: usize| place / STREET % 4 != 2;
        drives.push(town.drive(", streets not in the map", &is_street, 0..count));
        let is_half = |place: usize| (place / STREET).is_multiple_of(2);
        drives.push(town.drive(", half of the map", &is_half, 0..count));
        drives.push(kidnapped(town, elsewhere));
        let whole = elsewhere.drive("", &|_| true, 0..elsewhere.map.len());
        drives.push(never_there(town.drive(", never on the map", &|_| true, 0..1), &whole));
    }
    for set in &sets.traverses {
        let count = set.map.len();
        let order: Vec<usize> = (0..count).collect();
        drives.push(set.drive(", past the end", &|place| place < count / 2, &order));
        let is_half = |place: usize| (place * 10 / count).is_multiple_of(2);
        drives.push(set.drive(", half of the map", &is_half, &order));
        for other in sets.traverses.iter().filter(|other| other.name != set.name) {
            drives.push(swapped(set, other));
        }
    }
    Ok(drives)
}

/// A robot that is carried to another town, drives there, and is carried back.
fn kidnapped(town: &TownSet, elsewhere: &TownSet) -> Drive {
    let count = town.map.len();
    let mut drive = town.drive(", carried away and back", &|_| true, 0..count / 2);
    let away = elsewhere.drive("", &|_| true, 0..elsewhere.map.len());
    let back = town.drive("", &|_| true, count / 2..count);
    for (frames, is_away) in [(away.frames, true), (back.frames, false)] {
        follow_on(&mut drive.frames, frames, is_away);
    }
    drive
}

/// A drive in another town than that of the map.
fn never_there(drive: Drive, elsewhere: &Drive) -> Drive {
    let away = |frame: &Frame| Frame { truth: None, ..frame.clone() };
    Drive { frames: elsewhere.frames.iter().map(away).collect(), ..drive }
}

/// A third of one traverse, a third of another, and on.
fn swapped(set: &Traverse, other: &Traverse) -> Drive {
    let count = set.frames.len();
    let order = |from: usize, to: usize| (from..to).collect::<Vec<_>>();
    let mut drive = set.drive(", carried away and back", &|_| true, &order(0, count / 3));
    let away = other.drive("", &|_| true, &order(20, other.frames.len().min(80)));
    let back = set.drive("", &|_| true, &order(count / 3, count));
    for (frames, is_away) in [(away.frames, true), (back.frames, false)] {
        follow_on(&mut drive.frames, frames, is_away);
    }
    drive
}

/// Adds frames after others, two seconds later.
fn follow_on(frames: &mut Vec<Frame>, next: Vec<Frame>, is_away: bool) {
    let after = frames.last().map_or(0.0, |last| last.seconds + 2.0);
    frames.extend(next.into_iter().map(|frame| Frame {
        seconds: after + frame.seconds,
        truth: frame.truth.filter(|_| !is_away),
        ..frame
    }));
}
