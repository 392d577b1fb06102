//! Points, convex hulls and the rectangle of the least area around a set of points.

/// A point in a picture: x to the right, y down, in pixels.
pub(super) type Point = [f32; 2];

/// Corners of a quadrilateral: top left, top right, bottom right, bottom left in the picture.
pub(super) type Quad = [Point; 4];

pub(super) fn distance(a: Point, b: Point) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The convex hull of points, in order (Andrew's monotone chain, 1979).
fn hull(mut points: Vec<Point>) -> Vec<Point> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let turns_left = |a: Point, b: Point, c: Point| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0
    };
    let chain = |points: &mut dyn Iterator<Item = Point>| {
        let mut chain: Vec<Point> = Vec::new();
        for point in points {
            while let [.., before, last] = chain.as_slice()
                && !turns_left(*before, *last, point)
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    hull
}

/// A rectangle: its centre, a unit vector along its first side, and half the lengths of both sides.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rectangle {
    centre: Point,
    along: Point,
    half: [f32; 2],
}

impl Rectangle {
    /// The rectangle of the least area around points; one of its sides lies on a side of their hull (Freeman and
    /// Shapira, 1975). `None` without points.
    pub fn around(points: Vec<Point>) -> Option<Self> {
        let hull = hull(points);
        let first = *hull.first()?;
        let sides = hull.iter().zip(hull.iter().cycle().skip(1));
        let directions = sides.filter_map(|(a, b)| {
            let length = distance(*a, *b);
            (length > 0.0).then(|| [(b[0] - a[0]) / length, (b[1] - a[1]) / length])
        });
        let area = |rectangle: &Self| rectangle.half[0] * rectangle.half[1];
        directions
            .map(|along| Self::aligned(&hull, along))
            .min_by(|a, b| area(a).total_cmp(&area(b)))
            .or(Some(Self { centre: first, along: [1.0, 0.0], half: [0.0, 0.0] }))
    }

    fn aligned(hull: &[Point], along: Point) -> Self {
        let [ux, uy] = along;
        let mut bounds = [[f32::MAX, f32::MIN]; 2];
        for [x, y] in hull {
            for (bounds, place) in bounds.iter_mut().zip([x * ux + y * uy, y * ux - x * uy]) {
                *bounds = [bounds[0].min(place), bounds[1].max(place)];
            }
        }
        let [[left, right], [top, bottom]] = bounds;
        let (middle, across) = ((left + right) / 2.0, (top + bottom) / 2.0);
        Self {
            centre: [middle * ux - across * uy, middle * uy + across * ux],
            along,
            half: [(right - left) / 2.0, (bottom - top) / 2.0],
        }
    }

    /// The length of the shorter side.
    pub fn shorter(&self) -> f32 {
        2.0 * self.half[0].min(self.half[1])
    }

    /// The same, larger by `share` × area / perimeter on every side.
    pub fn enlarged(self, share: f32) -> Self {
        let [a, b] = self.half;
        let by = if a + b > 0.0 { share * a * b / (a + b) } else { 0.0 };
        Self { half: [a + by, b + by], ..self }
    }

    /// The corners, from the top left one clockwise, for text that runs to the right or, steeply, down or up.
    pub fn corners(&self) -> Quad {
        let ([cx, cy], [ux, uy], [a, b]) = (self.centre, self.along, self.half);
        let corner = |s: f32, t: f32| [cx + s * a * ux - t * b * uy, cy + s * a * uy + t * b * ux];
        let mut all = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        all.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let [mut top_left, mut bottom_left, mut top_right, mut bottom_right] = all;
        if top_left[1] > bottom_left[1] {
            std::mem::swap(&mut top_left, &mut bottom_left);
        }
        if top_right[1] > bottom_right[1] {
            std::mem::swap(&mut top_right, &mut bottom_right);
        }
        [top_left, top_right, bottom_right, bottom_left]
    }
}

/// Whether a point is in a convex quadrilateral or on its edge.
pub(super) fn contains(quad: &Quad, [x, y]: Point) -> bool {
    let sides = quad.iter().zip(quad.iter().cycle().skip(1));
    let turns = sides.map(|(a, b)| (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]));
    let (least, most) =
        turns.fold((f32::MAX, f32::MIN), |(least, most), turn| (least.min(turn), most.max(turn)));
    least >= -1e-3 || most <= 1e-3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rectangle_around_a_turned_rectangle_is_itself() {
        for degrees in [0.0_f32, 10.0, 45.0, 80.0, -30.0] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let turned = |x: f32, y: f32| [50.0 + x * cos - y * sin, 40.0 + x * sin + y * cos];
            let points = (-20..=20).flat_map(|x| (-5..=5).map(move |y| turned(x as f32, y as f32)));
            let rectangle = Rectangle::around(points.collect()).unwrap();
            assert!((rectangle.shorter() - 10.0).abs() < 1e-2, "{degrees}: {rectangle:?}");
            let [a, b, c, d] = rectangle.corners();
            let mut sides = [distance(a, b), distance(b, c)];
            sides.sort_by(f32::total_cmp);
            assert!((sides[1] - 40.0).abs() < 1e-2, "{degrees}");
            assert!(a[1] <= d[1] && b[1] <= c[1] && a[0] <= b[0] && d[0] <= c[0], "{degrees}");
        }
    }

    #[test]
    fn few_points_have_a_flat_rectangle() {
        assert!(Rectangle::around(Vec::new()).is_none());
        for points in [vec![[3.0, 4.0]], vec![[3.0, 4.0], [5.0, 4.0]]] {
            assert_eq!(Rectangle::around(points).unwrap().shorter(), 0.0);
        }
    }

    #[test]
    fn enlarging_moves_every_side_by_the_share_of_area_over_perimeter() {
        let square =
            Rectangle::around(vec![[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]]).unwrap();
        // 100 / 40 × 2 = 5 on each side.
        assert!((square.enlarged(2.0).shorter() - 20.0).abs() < 1e-4);
        assert!(
            contains(&square.corners(), [10.0, 5.0]) && !contains(&square.corners(), [10.1, 5.0])
        );
    }
}
