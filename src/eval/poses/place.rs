//! Where a picture was taken, in every way that a source says it, and in the coordinates of a map.

use whereabouts_core::{CoordinateFrame, GeographicPose, MetricPose, Pose, PoseInput, UtmZone};

/// A place as a source gives it: in degrees, in metres, or in both.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Place {
    pub geographic: Option<GeographicPose>,
    pub metric: Option<MetricPose>,
    /// The zone of the metres, if they are UTM coordinates of a known zone.
    pub zone: Option<UtmZone>,
}

/// The coordinates of a whole folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Grid {
    Wgs84,
    /// Metres, in a UTM zone if it is known.
    Metric(Option<UtmZone>),
}

impl Grid {
    pub(super) fn frame(self) -> CoordinateFrame {
        match self {
            Self::Wgs84 => CoordinateFrame::Wgs84,
            Self::Metric(_) => CoordinateFrame::Metric,
        }
    }
}

impl Place {
    pub(super) fn of(pose: Pose) -> Self {
        match pose {
            Pose::Geographic(pose) => Self { geographic: Some(pose), ..Self::default() },
            Pose::Metric(pose) => Self { metric: Some(pose), ..Self::default() },
        }
    }

    /// Converts the place to the coordinates of a folder, or says why it cannot be.
    pub(super) fn in_grid(&self, grid: Grid) -> Result<Pose, &'static str> {
        match grid {
            Grid::Wgs84 => self
                .degrees()
                .map(Pose::Geographic)
                .ok_or("its position is in metres without a UTM zone, not in degrees"),
            Grid::Metric(zone) => self
                .metres(zone)
                .map(Pose::Metric)
                .ok_or("its position is in degrees, not in metres"),
        }
    }

    fn degrees(&self) -> Option<GeographicPose> {
        self.geographic.or_else(|| {
            let (pose, zone) = (self.metric?, self.zone?);
            let (lat, lon) = zone.to_degrees(pose.x, pose.y)?;
            Some(GeographicPose { lat, lon, alt: pose.z, heading: None })
        })
    }

    fn metres(&self, grid: Option<UtmZone>) -> Option<MetricPose> {
        let is_in_grid = self.zone.is_none() || grid.is_none() || self.zone == grid;
        if let Some(pose) = self.metric.filter(|_| is_in_grid) {
            return Some(pose);
        }
        let (pose, zone) = (self.degrees()?, grid?);
        let (x, y) = zone.to_metres(pose.lat, pose.lon)?;
        Some(MetricPose { x, y, z: pose.alt, qx: None, qy: None, qz: None, qw: None })
    }
}

/// Validates numbers in the frame to which they belong.
pub(super) fn checked(input: PoseInput, frame: CoordinateFrame) -> anyhow::Result<Pose> {
    Ok(input.check(frame)?)
}
