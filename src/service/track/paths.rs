//! The map as paths: which image comes next, in either direction, and where one path meets another.
//!
//! A map is usually recorded by driving, so the order of its images is mostly the way that a robot takes. Images
//! that follow each other are neighbours on a path, unless they are far apart; the ends that remain, and all images of
//! a map whose order says nothing, are joined to the nearest image ahead. Where paths cross, branch, or run side by
//! side, *links* lead from one to the other.

use super::grid::Grid;

/// No image.
const NONE: u32 = u32::MAX;

/// Images that follow each other are not neighbours if they are this many times further apart than usual.
const MAX_GAP: f64 = 200.0;

/// Maximum distance of images that are joined without following each other, in units of the usual one.
const MAX_JOIN: f64 = 2.5;

/// Maximum distance of two linked images, in units of the usual distance of neighbours.
const MAX_LINK: f64 = 1.3;

/// Images fewer steps apart on one path than this are not linked.
const MIN_STEPS: u32 = 4;

/// Maximum number of links of an image.
const MAX_LINKS: usize = 6;

/// Maximum number of images around one that are looked at.
const MAX_AROUND: usize = 64;

/// A smaller map is always believed to be in order.
const MIN_ORDERED: usize = 8;

/// Cosine of the sharpest angle between two neighbours of an image that are joined without following each other.
const SHARPEST: f64 = 0.3;

/// Cosine of the largest angle at which a road that branches off is straight.
const STRAIGHT: f64 = 0.7;

/// The paths of a map.
#[derive(Debug)]
pub(super) struct Paths {
    /// The image behind and the one ahead of each.
    neighbours: Vec<[u32; 2]>,
    /// The course of the path at each image, in radians.
    courses: Vec<f64>,
    /// Ends of the links of each image in `links`: those of image i are from i to i + 1.
    link_ends: Vec<u32>,
    links: Vec<u32>,
    /// The usual distance between neighbours, in metres.
    spacing: f64,
}

/// An image on the way of a robot, its direction there, and the distance so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stop {
    pub image: u32,
    /// Whether the robot moves ahead on the path.
    pub ahead: bool,
    pub metres: f64,
}

impl Paths {
    /// Finds the paths among positions that are numbered in the order of recording.
    pub fn new(grid: &Grid, min_spacing: f64) -> Self {
        let count = grid.len();
        let steps: Vec<f64> =
            (1..count).map(|to| grid.distance(to as u32 - 1, to as u32)).collect();
        let is_ordered = count < MIN_ORDERED || is_shorter_than_by_chance(grid, &steps);
        // Several views of one spot, or a robot that stood still while it recorded, are no steps.
        let real = |step: &f64| *step > STANDING_M;
        let spacing = match is_ordered {
            true => median(steps.iter().copied().filter(real).collect()),
            false => median_to_nearest(grid),
        };
        let spacing = spacing.max(min_spacing);
        let mut joints = Joints::new(count);
        if is_ordered {
            for (from, metres) in steps.iter().enumerate() {
                if *metres <= MAX_GAP * spacing {
                    joints.join(from as u32, from as u32 + 1);
                }
            }
        }
        joints.join_ends(grid, MAX_JOIN * spacing);
        let (neighbours, places) = joints.into_paths();
        let mut paths = Self {
            courses: courses(grid, &neighbours),
            neighbours,
            link_ends: vec![0],
            links: Vec::new(),
            spacing,
        };
        for image in 0..count as u32 {
            paths.link(image, grid, &places);
        }
        paths
    }

    /// The usual distance between neighbours, in metres.
    pub fn spacing(&self) -> f64 {
        self.spacing
    }

    /// Adds the links of the next image.
    fn link(&mut self, image: u32, grid: &Grid, places: &[[u32; 2]]) {
        let [path, step] = places[image as usize];
        let is_end = self.neighbours[image as usize].contains(&NONE);
        let radius = if is_end { MAX_JOIN } else { MAX_LINK } * self.spacing;
        let mut near = grid.near(image, radius, MAX_AROUND).unwrap_or_default();
        near.retain(|(other, _)| {
            let [other_path, other_step] = places[*other as usize];
            *other != image && (other_path != path || other_step.abs_diff(step) >= MIN_STEPS)
        });
        near.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        // Of each other path only the nearest part.
        let mut linked: Vec<[u32; 2]> = Vec::new();
        for (other, _) in near {
            let place = places[other as usize];
            let is_new = linked
                .iter()
                .all(|known| known[0] != place[0] || known[1].abs_diff(place[1]) >= MIN_STEPS);
            if is_new && linked.len() < MAX_LINKS {
                linked.push(place);
                self.links.push(other);
            }
        }
        self.link_ends.push(self.links.len() as u32);
    }

    /// The images behind and ahead of one.
    pub fn neighbours(&self, image: u32) -> impl Iterator<Item = u32> + use<> {
        self.neighbours[image as usize].into_iter().filter(|other| *other != NONE)
    }

    fn links(&self, image: u32) -> &[u32] {
        let ends = [self.link_ends[image as usize], self.link_ends[image as usize + 1]];
        &self.links[ends[0] as usize..ends[1] as usize]
    }

    /// The course of a robot at an image, in radians.
    pub fn course(&self, image: u32, ahead: bool) -> f64 {
        let course = self.courses[image as usize];
        if ahead { course } else { course + std::f64::consts::PI }
    }

    /// The images on the way from one, in the order in which they are reached, up to the first beyond `reach`
    /// metres; and in `branches` the same for each way that leaves the path through a link.
    pub fn walk(
        &self,
        grid: &Grid,
        start: Stop,
        reach: f64,
        (way, branches): (&mut Vec<Stop>, &mut Vec<Vec<Stop>>),
    ) {
        way.clear();
        branches.clear();
        // Other views of the spot that are behind it in order.
        let mut behind = start.image;
        loop {
            let next = self.neighbours[behind as usize][usize::from(!start.ahead)];
            let is_same = next != NONE && grid.distance(start.image, next) <= self.same_spot();
            if !is_same || way.len() == MAX_VIEWS {
                break;
            }
            way.push(Stop { image: next, ..start });
            behind = next;
        }
        let first = way.len();
        self.follow(grid, start, reach, way);
        // The stop and the image of each link taken.
        let mut taken: Vec<(usize, u32)> = Vec::new();
        for passed in first..way.len() {
            let at = way[passed];
            if at.metres > reach {
                break;
            }
            for link in self.links(at.image) {
                if branches.len() == MAX_LINKS {
                    return;
                }
                // A path that runs beside this one is entered once.
                let is_beside = |(stop, image): &(usize, u32)| {
                    link.abs_diff(*image) <= (passed - stop) as u32 + MIN_STEPS
                };
                if taken.iter().any(is_beside) {
                    continue;
                }
                taken.push((passed, *link));
                let [x, y] = grid.offset(at.image, *link);
                let course = self.course(at.image, at.ahead);
                let metres = at.metres + x.hypot(y).min(self.spacing);
                for ahead in [true, false] {
                    let onward = self.course(*link, ahead);
                    // Side by side the direction stays; at a crossing, both ways lead on.
                    let is_on = (onward - course).cos() > -SHARPEST;
                    // Where a road branches off, its first image is a step away.
                    let is_off =
                        x.hypot(y) > self.spacing / 2.0 && (onward - y.atan2(x)).cos() > STRAIGHT;
                    if (is_on || is_off) && branches.len() < MAX_LINKS {
                        let mut branch = way[..=passed].to_vec();
                        self.follow(grid, Stop { image: *link, ahead, metres }, reach, &mut branch);
                        branches.push(branch);
                    }
                }
            }
        }
    }

    /// Images closer than this are views of one spot, in metres.
    pub fn same_spot(&self) -> f64 {
        SAME_SPOT * self.spacing
    }

    /// Whether the map ends at a stop: no image comes after it, on its path or on another.
    pub fn is_end(&self, at: Stop) -> bool {
        self.neighbours[at.image as usize][usize::from(at.ahead)] == NONE
            && self.links(at.image).is_empty()
    }

    /// The next stop on a path.
    pub fn next(&self, grid: &Grid, at: Stop) -> Option<Stop> {
        let next = self.neighbours[at.image as usize][usize::from(at.ahead)];
        let metres = || at.metres + grid.distance(at.image, next);
        (next != NONE).then(|| Stop { image: next, metres: metres(), ..at })
    }

    fn follow(&self, grid: &Grid, start: Stop, reach: f64, way: &mut Vec<Stop>) {
        let mut at = start;
        way.push(at);
        let first = way.len();
        while at.metres <= reach {
            let next = self.neighbours[at.image as usize][usize::from(at.ahead)];
            if next == NONE || next == start.image || way.len() - first > MAX_STOPS {
                return;
            }
            let metres = at.metres + grid.distance(at.image, next);
            at = Stop { image: next, metres, ..at };
            way.push(at);
        }
    }
}

/// Maximum number of images on the way of one step.
const MAX_STOPS: usize = 512;

/// Maximum number of images of one spot that are behind one in order.
const MAX_VIEWS: usize = 64;

/// Images closer than this, in units of the usual distance of neighbours, are views of one spot.
const SAME_SPOT: f64 = 0.02;

/// Shorter steps than this, in metres, are none.
const STANDING_M: f64 = 0.01;

/// The neighbours of each image while paths are being built, in no direction.
struct Joints {
    joined: Vec<[u32; 2]>,
}

impl Joints {
    fn new(count: usize) -> Self {
        Self { joined: vec![[NONE; 2]; count] }
    }

    fn join(&mut self, one: u32, other: u32) {
        for (from, to) in [(one, other), (other, one)] {
            let joined = &mut self.joined[from as usize];
            let free = usize::from(joined[0] != NONE);
            joined[free] = to;
        }
    }

    fn is_end(&self, image: u32) -> bool {
        self.joined[image as usize][1] == NONE
    }

    /// Whether `to` lies on the other side of `from` than its neighbour.
    fn leads_on(&self, grid: &Grid, from: u32, to: u32) -> bool {
        let [behind, _] = self.joined[from as usize];
        if behind == NONE {
            return true;
        }
        let ([ax, ay], [bx, by]) = (grid.offset(from, behind), grid.offset(from, to));
        let lengths = ax.hypot(ay) * bx.hypot(by);
        behind != to && ax * bx + ay * by < SHARPEST * lengths
    }

    /// Joins ends of paths with the nearest other ends, the closest pairs first.
    fn join_ends(&mut self, grid: &Grid, radius: f64) {
        let mut pairs = Vec::new();
        for image in (0..self.joined.len() as u32).filter(|image| self.is_end(*image)) {
            let near = grid.near(image, radius, MAX_AROUND).unwrap_or_default();
            let near = near.into_iter().filter(|(other, _)| image < *other && self.is_end(*other));
            pairs.extend(near.map(|(other, metres)| (metres, image, other)));
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, one, other) in pairs {
            if self.is_end(one)
                && self.is_end(other)
                && self.leads_on(grid, one, other)
                && self.leads_on(grid, other, one)
            {
                self.join(one, other);
            }
        }
    }

    /// Gives each path a direction. Returns the image behind and the one ahead of each, and its path and its position
    /// there.
    fn into_paths(self) -> (Vec<[u32; 2]>, Vec<[u32; 2]>) {
        let count = self.joined.len();
        let mut neighbours = vec![[NONE; 2]; count];
        let mut places = vec![[NONE, 0]; count];
        let ends = (0..count as u32).filter(|image| self.is_end(*image));
        // Ends first; what is left then are circles.
        for (path, start) in (0..).zip(ends.chain(0..count as u32)) {
            let (mut behind, mut at, mut step) = (NONE, start, 0);
            while at != NONE && places[at as usize][0] == NONE {
                places[at as usize] = [path, step];
                let [one, other] = self.joined[at as usize];
                // The lower number is ahead of the first image of a circle, in the order of recording.
                let is_back =
                    if behind == NONE { one > other && other != NONE } else { one == behind };
                let ahead = if is_back { other } else { one };
                let back = if is_back { one } else { other };
                neighbours[at as usize] = [back, ahead];
                (behind, at, step) = (at, ahead, step + 1);
            }
        }
        (neighbours, places)
    }
}

/// The course at each image: from the one behind it to the one ahead.
fn courses(grid: &Grid, neighbours: &[[u32; 2]]) -> Vec<f64> {
    let course = |(image, [behind, ahead]): (u32, &[u32; 2])| {
        let or_self = |other: u32| if other == NONE { image } else { other };
        let [x, y] = grid.offset(or_self(*behind), or_self(*ahead));
        y.atan2(x)
    };
    (0..).zip(neighbours).map(course).collect()
}

/// Whether images that follow each other are much closer than any two are.
fn is_shorter_than_by_chance(grid: &Grid, steps: &[f64]) -> bool {
    let count = grid.len() as u32;
    // Pairs that are far apart in number, the same in every run.
    let others = (0..count).map(|one| grid.distance(one, (one + count / 2 + one % 7) % count));
    median(steps.to_vec()) < 0.4 * median(others.collect())
}

/// Estimates the median distance to the nearest position, from a sample spread over the map.
fn median_to_nearest(grid: &Grid) -> f64 {
    const SAMPLE: usize = 200;
    let step = grid.len().div_ceil(SAMPLE).max(1);
    let count = grid.len() as u32;
    let nearest = (0..count).step_by(step).filter_map(|one| {
        let others = (0..count).map(|other| grid.distance(one, other));
        others.filter(|metres| *metres > STANDING_M).min_by(f64::total_cmp)
    });
    median(nearest.collect())
}

/// The median; 0 of nothing.
fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers.get(numbers.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests;
