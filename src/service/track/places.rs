//! Where the images of a map were taken, as the filter of a track asks: which are near which.

use std::collections::HashMap;

use whereabouts_core::{EARTH_RADIUS_M, ImageId, Pose};

/// The least that a place is wide, in metres: maps that have many images of one spot say nothing of it.
const LEAST_SPACING_M: f64 = 0.5;

/// The images of a map that have a pose, by a number, with their positions in a plane.
#[derive(Debug)]
pub(super) struct Places {
    ids: Vec<ImageId>,
    poses: Vec<Pose>,
    /// Metres in a plane; for geographic poses in the equirectangular one about the first image, good to
    /// a metre over some tens of kilometres.
    positions: Vec<[f64; 2]>,
    /// The median distance from an image to the nearest other one, in metres.
    spacing: f64,
    numbers: HashMap<ImageId, u32>,
    /// Which images are in which square of so many metres.
    squares: HashMap<[i64; 2], Vec<u32>>,
    edge: f64,
}

impl Places {
    /// Lays out the images of a map.
    pub fn new(images: Vec<(ImageId, Pose)>) -> Self {
        let (ids, poses): (Vec<_>, Vec<_>) = images.into_iter().unzip();
        let positions = in_a_plane(&poses);
        let numbers = ids.iter().cloned().zip(0..).collect();
        // About one image in each square, whatever the map's size.
        let edge =
            (extent(&positions) / (positions.len().max(1) as f64).sqrt()).max(LEAST_SPACING_M);
        let mut places =
            Self { ids, poses, positions, spacing: 0.0, numbers, squares: HashMap::new(), edge };
        for (number, position) in (0..).zip(&places.positions) {
            places.squares.entry(square(*position, edge)).or_default().push(number);
        }
        places.spacing = places.median_spacing();
        places
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// The median distance from an image to the nearest other one, in metres.
    pub fn spacing(&self) -> f64 {
        self.spacing
    }

    pub fn id(&self, number: u32) -> &ImageId {
        &self.ids[number as usize]
    }

    pub fn pose(&self, number: u32) -> Pose {
        self.poses[number as usize]
    }

    pub fn number(&self, id: &ImageId) -> Option<u32> {
        self.numbers.get(id).copied()
    }

    /// Metres between two images.
    pub fn distance(&self, one: u32, other: u32) -> f64 {
        between(self.positions[one as usize], self.positions[other as usize])
    }

    /// Images within `radius` metres of one, itself included, with their distances, in no order;
    /// `None` if there are more than `most`, and for a circle so large that there probably are.
    pub fn near(&self, one: u32, radius: f64, most: usize) -> Option<Vec<(u32, f64)>> {
        let edges = (2.0 * radius / self.edge).ceil() + 1.0;
        let squares = edges * edges;
        let mut found = Vec::new();
        let mut take = |number: u32| {
            let distance = self.distance(one, number);
            if distance <= radius {
                found.push((number, distance));
            }
            found.len() <= most
        };
        let all_taken = if squares < (self.len().min(2 * most)) as f64 {
            let centre = self.positions[one as usize];
            let corner = |way: f64| square([centre[0] + way, centre[1] + way], self.edge);
            let [low, high] = [corner(-radius), corner(radius)];
            let mut wanted =
                (low[0]..=high[0]).flat_map(|x| (low[1]..=high[1]).map(move |y| [x, y]));
            wanted.all(|square| {
                self.squares.get(&square).is_none_or(|numbers| numbers.iter().all(|n| take(*n)))
            })
        } else {
            // A small map is looked at as a whole. A circle over so much of a large one holds too many.
            self.len() <= 4 * most && (0..self.len() as u32).all(take)
        };
        all_taken.then_some(found)
    }

    /// Of some hundred images, spread over the map.
    fn median_spacing(&self) -> f64 {
        const ASKED: usize = 200;
        let step = self.len().div_ceil(ASKED).max(1);
        let mut spacings: Vec<f64> = (0..self.len())
            .step_by(step)
            .filter_map(|one| {
                let others = (0..self.len()).filter(|other| *other != one);
                others.map(|other| self.distance(one as u32, other as u32)).min_by(f64::total_cmp)
            })
            .collect();
        spacings.sort_by(f64::total_cmp);
        spacings.get(spacings.len() / 2).copied().unwrap_or(0.0).max(LEAST_SPACING_M)
    }
}

fn between(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn square(position: [f64; 2], edge: f64) -> [i64; 2] {
    position.map(|metres| (metres / edge).floor() as i64)
}

/// The longer edge of the box around all positions, in metres.
fn extent(positions: &[[f64; 2]]) -> f64 {
    let span = |axis: usize| {
        let (low, high) = positions.iter().fold((f64::MAX, f64::MIN), |(low, high), position| {
            (low.min(position[axis]), high.max(position[axis]))
        });
        (high - low).max(0.0)
    };
    span(0).max(span(1))
}

fn in_a_plane(poses: &[Pose]) -> Vec<[f64; 2]> {
    let origin = poses.iter().find_map(|pose| match pose {
        Pose::Geographic(pose) => Some((pose.lat, pose.lon)),
        Pose::Metric(_) => None,
    });
    let (lat, lon) = origin.unwrap_or_default();
    let place = |pose: &Pose| match pose {
        Pose::Metric(pose) => [pose.x, pose.y],
        Pose::Geographic(pose) => {
            // Across the date line the shorter way.
            let east = (pose.lon - lon + 540.0).rem_euclid(360.0) - 180.0;
            let scale = EARTH_RADIUS_M * lat.to_radians().cos();
            [east.to_radians() * scale, (pose.lat - lat).to_radians() * EARTH_RADIUS_M]
        }
    };
    poses.iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::{GeographicPose, MetricPose};

    fn metric(x: f64, y: f64) -> Pose {
        Pose::Metric(MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None })
    }

    fn row(count: usize, apart: f64) -> Places {
        let image = |i: usize| (format!("i{i}").parse().unwrap(), metric(i as f64 * apart, 0.0));
        Places::new((0..count).map(image).collect())
    }

    #[test]
    fn those_within_the_radius_are_near() {
        let places = row(1000, 2.0);
        assert_eq!(places.spacing(), 2.0);
        let mut near = places.near(500, 4.5, 100).unwrap();
        near.sort_by_key(|(number, _)| *number);
        let expected = [(498, 4.0), (499, 2.0), (500, 0.0), (501, 2.0), (502, 4.0)];
        assert_eq!(near, expected);
        assert_eq!(places.near(500, 4.5, 4), None);
        assert_eq!(places.near(0, 1e9, 2000).unwrap().len(), 1000);
        assert_eq!(places.near(0, 1e9, 999), None);
        assert_eq!(places.near(0, 1e300, 100), None);
        assert_eq!(places.number(places.id(7)), Some(7));
    }

    #[test]
    fn a_map_of_one_spot_has_a_least_spacing() {
        assert_eq!(row(50, 0.0).spacing(), LEAST_SPACING_M);
        assert_eq!(row(1, 0.0).near(0, 1.0, 5), Some(vec![(0, 0.0)]));
        assert_eq!(row(0, 0.0).spacing(), LEAST_SPACING_M);
    }

    #[test]
    fn positions_on_the_globe_are_metres_and_the_date_line_is_no_border() {
        let at = |lat, lon| Pose::Geographic(GeographicPose { lat, lon, alt: None, heading: None });
        let poses = [at(-17.0, 179.9995), at(-17.0, -179.9995), at(-17.001, 179.9995)];
        let images = poses.iter().enumerate();
        let places =
            Places::new(images.map(|(i, pose)| (i.to_string().parse().unwrap(), *pose)).collect());
        for other in [1, 2] {
            let exact = poses[0].distance_m(&poses[other]).unwrap();
            assert!((places.distance(0, other as u32) - exact).abs() < 0.1, "{exact}");
        }
    }
}
