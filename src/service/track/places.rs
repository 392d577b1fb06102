//! The positions of the images of a map in a plane, and which images are near which.

use std::collections::HashMap;

use whereabouts_core::{EARTH_RADIUS_M, ImageId, Pose};

/// Minimum spacing in metres, for maps that have several images of each spot.
const MIN_SPACING_M: f64 = 0.5;

/// The images of a map that have a pose, numbered, with a grid for neighbourhood queries.
#[derive(Debug)]
pub(super) struct Places {
    ids: Vec<ImageId>,
    poses: Vec<Pose>,
    /// Metres in a plane; for geographic poses in the equirectangular projection around the first image, which is
    /// accurate to a metre over some tens of kilometres.
    positions: Vec<[f64; 2]>,
    /// The median distance from an image to the nearest other one, in metres.
    spacing: f64,
    numbers: HashMap<ImageId, u32>,
    /// The images in each cell of the grid.
    cells: HashMap<[i64; 2], Vec<u32>>,
    /// Edge of a cell in metres.
    edge: f64,
}

impl Places {
    /// Builds the grid over the images of a map.
    pub fn new(images: Vec<(ImageId, Pose)>) -> Self {
        let (ids, poses): (Vec<_>, Vec<_>) = images.into_iter().unzip();
        let positions = in_a_plane(&poses);
        let numbers = ids.iter().cloned().zip(0..).collect();
        // About one image in each cell, whatever the size of the map.
        let edge = (extent(&positions) / (positions.len().max(1) as f64).sqrt()).max(MIN_SPACING_M);
        let mut places =
            Self { ids, poses, positions, spacing: 0.0, numbers, cells: HashMap::new(), edge };
        for (number, position) in (0..).zip(&places.positions) {
            places.cells.entry(cell(*position, edge)).or_default().push(number);
        }
        places.spacing = places.median_spacing();
        places
    }

    /// The number of images.
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

    /// The distance between two images, in metres.
    pub fn distance(&self, one: u32, other: u32) -> f64 {
        between(self.positions[one as usize], self.positions[other as usize])
    }

    /// Returns the images within `radius` metres of one, itself included, with their distances, in no order;
    /// `None` if there are more than `max`, or if the circle is so large that there probably are.
    pub fn near(&self, one: u32, radius: f64, max: usize) -> Option<Vec<(u32, f64)>> {
        let edges = (2.0 * radius / self.edge).ceil() + 1.0;
        let cells = edges * edges;
        let mut found = Vec::new();
        let mut take = |number: u32| {
            let distance = self.distance(one, number);
            if distance <= radius {
                found.push((number, distance));
            }
            found.len() <= max
        };
        let all_taken = if cells < (self.len().min(2 * max)) as f64 {
            let centre = self.positions[one as usize];
            let corner = |offset: f64| cell([centre[0] + offset, centre[1] + offset], self.edge);
            let [low, high] = [corner(-radius), corner(radius)];
            let mut in_reach =
                (low[0]..=high[0]).flat_map(|x| (low[1]..=high[1]).map(move |y| [x, y]));
            in_reach.all(|cell| {
                self.cells.get(&cell).is_none_or(|numbers| numbers.iter().all(|n| take(*n)))
            })
        } else {
            // A small map is scanned. A circle over this much of a large map holds too many images.
            self.len() <= 4 * max && (0..self.len() as u32).all(take)
        };
        all_taken.then_some(found)
    }

    /// Estimates the median distance to the nearest image, from a sample spread over the map.
    fn median_spacing(&self) -> f64 {
        const SAMPLE: usize = 200;
        let step = self.len().div_ceil(SAMPLE).max(1);
        let mut spacings: Vec<f64> = (0..self.len())
            .step_by(step)
            .filter_map(|one| {
                let others = (0..self.len()).filter(|other| *other != one);
                others.map(|other| self.distance(one as u32, other as u32)).min_by(f64::total_cmp)
            })
            .collect();
        spacings.sort_by(f64::total_cmp);
        spacings.get(spacings.len() / 2).copied().unwrap_or(0.0).max(MIN_SPACING_M)
    }
}

fn between(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn cell(position: [f64; 2], edge: f64) -> [i64; 2] {
    position.map(|metres| (metres / edge).floor() as i64)
}

/// The longer edge of the bounding box of all positions, in metres.
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
            // The shorter way around, across the date line.
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
    fn images_within_the_radius_are_near() {
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
    fn a_map_of_one_spot_has_the_minimum_spacing() {
        assert_eq!(row(50, 0.0).spacing(), MIN_SPACING_M);
        assert_eq!(row(1, 0.0).near(0, 1.0, 5), Some(vec![(0, 0.0)]));
        assert_eq!(row(0, 0.0).spacing(), MIN_SPACING_M);
    }

    #[test]
    fn geographic_positions_are_in_metres_also_across_the_date_line() {
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
