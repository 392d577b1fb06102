//! Positions in a plane, with a grid for neighbourhood queries.

use std::collections::HashMap;

/// Minimum edge of a cell in metres, for maps that have several images of each spot.
const MIN_EDGE_M: f64 = 0.5;

/// Numbered positions in metres.
#[derive(Debug)]
pub(super) struct Grid {
    positions: Vec<[f64; 2]>,
    /// The positions in each cell.
    cells: HashMap<[i64; 2], Vec<u32>>,
    /// Edge of a cell in metres.
    edge: f64,
}

impl Grid {
    /// Builds a grid with about one position in each cell, whatever the size of the map.
    pub fn new(positions: Vec<[f64; 2]>) -> Self {
        let count = positions.len().max(1) as f64;
        let edge = (extent(&positions) / count.sqrt()).max(MIN_EDGE_M);
        let mut cells: HashMap<_, Vec<u32>> = HashMap::new();
        for (number, position) in (0..).zip(&positions) {
            cells.entry(cell(*position, edge)).or_default().push(number);
        }
        Self { positions, cells, edge }
    }

    /// The number of positions.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// The vector from one position to another, in metres.
    pub fn offset(&self, from: u32, to: u32) -> [f64; 2] {
        let (from, to) = (self.positions[from as usize], self.positions[to as usize]);
        [to[0] - from[0], to[1] - from[1]]
    }

    /// The distance between two positions, in metres.
    pub fn distance(&self, one: u32, other: u32) -> f64 {
        let [x, y] = self.offset(one, other);
        x.hypot(y)
    }

    /// Returns the positions within `radius` metres of one, itself included, with their distances, in no order;
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

#[cfg(test)]
mod tests {
    use super::*;

    fn row(count: usize, apart: f64) -> Grid {
        Grid::new((0..count).map(|number| [number as f64 * apart, 0.0]).collect())
    }

    #[test]
    fn positions_within_the_radius_are_near() {
        let grid = row(1000, 2.0);
        let mut near = grid.near(500, 4.5, 100).unwrap();
        near.sort_by_key(|(number, _)| *number);
        let expected = [(498, 4.0), (499, 2.0), (500, 0.0), (501, 2.0), (502, 4.0)];
        assert_eq!(near, expected);
        assert_eq!(grid.near(500, 4.5, 4), None);
        assert_eq!(grid.near(0, 1e9, 2000).unwrap().len(), 1000);
        assert_eq!(grid.near(0, 1e9, 999), None);
        assert_eq!(grid.near(0, 1e300, 100), None);
    }

    #[test]
    fn equal_positions_are_near_each_other() {
        assert_eq!(row(1, 0.0).near(0, 1.0, 5), Some(vec![(0, 0.0)]));
        assert_eq!(row(3, 0.0).near(1, 1.0, 5).map(|near| near.len()), Some(3));
    }
}
