//! A pinhole camera, and the projection of flat rectangles.
//!
//! On a plane, inverse depth and both surface coordinates divided by depth are *linear* in the
//! pixel position. A [`View`] holds those three linear forms, which makes perspective exact and
//! leaves one division per pixel.

use super::geometry::{Panel, Vec3, vec3};

/// Horizontal field of view, in radians (72°).
const FIELD_OF_VIEW: f32 = 1.256_637;

/// Distance of the near clipping plane in metres.
const NEAR: f32 = 0.15;

/// The pose of a camera in the street's frame.
#[derive(Clone, Copy)]
pub(super) struct Pose {
    pub eye: Vec3,
    /// Radians, anticlockwise from the street's axis.
    pub yaw: f32,
    /// Radians above the horizon.
    pub pitch: f32,
    /// Radians, clockwise.
    pub roll: f32,
}

pub(super) struct Camera {
    pub eye: Vec3,
    right: Vec3,
    up: Vec3,
    pub forward: Vec3,
    focal: f32,
    /// One over the focal length.
    per_pixel: f32,
    centre: (f32, f32),
}

impl Camera {
    pub fn new(pose: &Pose, width: u32, height: u32) -> Camera {
        let (sin_yaw, cos_yaw) = pose.yaw.sin_cos();
        let (sin_pitch, cos_pitch) = pose.pitch.sin_cos();
        let forward = vec3(cos_yaw * cos_pitch, sin_yaw * cos_pitch, sin_pitch);
        let level = vec3(sin_yaw, -cos_yaw, 0.0);
        let steep = level.cross(forward);
        let (sin_roll, cos_roll) = pose.roll.sin_cos();
        let focal = width as f32 / 2.0 / (FIELD_OF_VIEW / 2.0).tan();
        Camera {
            eye: pose.eye,
            right: level * cos_roll - steep * sin_roll,
            up: steep * cos_roll + level * sin_roll,
            forward,
            focal,
            per_pixel: 1.0 / focal,
            centre: (width as f32 / 2.0, height as f32 / 2.0),
        }
    }

    /// The direction seen at a pixel, scaled so that its component along the optical axis is 1.
    #[inline]
    pub fn ray(&self, x: f32, y: f32) -> Vec3 {
        self.forward
            + self.right * ((x - self.centre.0) * self.per_pixel)
            + self.up * ((self.centre.1 - y) * self.per_pixel)
    }

    /// Pixel position of a point in front of the camera, and its depth in metres.
    pub fn project(&self, point: Vec3) -> Option<(f32, f32, f32)> {
        let seen = self.in_frame(point);
        (seen.z > NEAR).then(|| {
            let (x, y) = self.on_image(seen);
            (x, y, seen.z)
        })
    }

    /// The horizontal unit vector to the right, along which billboards are spread.
    pub fn rightwards(&self) -> Vec3 {
        vec3(self.forward.y, -self.forward.x, 0.0).unit()
    }

    /// Whether anything within `reach` metres of a point is in front of the camera and close enough
    /// to matter.
    pub fn may_see(&self, point: Vec3, reach: f32) -> bool {
        const HORIZON: f32 = 60.0;
        let depth = self.in_frame(point).z;
        depth > -reach && depth < HORIZON
    }

    /// Projects `panel`; `None` if it is edge-on or behind the camera.
    pub fn view(&self, panel: &Panel) -> Option<View> {
        let normal = panel.normal();
        let reach = normal.dot(panel.corner - self.eye);
        let outline = self.outline(panel);
        if reach.abs() < 1e-4 || outline.len() < 3 {
            return None;
        }
        let inverse_depth = self.along_rays(normal * (1.0 / reach));
        let offset = self.eye - panel.corner;
        let over_depth =
            |axis: Vec3| self.along_rays(axis).plus(inverse_depth.times(axis.dot(offset)));
        Some(View {
            foot: (panel.along.dot(offset), panel.up.dot(offset)),
            per_reach: 1.0 / reach.abs(),
            inverse_depth,
            u_over_depth: over_depth(panel.along),
            v_over_depth: over_depth(panel.up),
            outline,
        })
    }

    /// `axis · ray(x, y)` as a linear form in the pixel position.
    fn along_rays(&self, axis: Vec3) -> Linear {
        let (dx, dy) = (axis.dot(self.right) / self.focal, -axis.dot(self.up) / self.focal);
        Linear {
            at_origin: axis.dot(self.forward) - dx * self.centre.0 - dy * self.centre.1,
            dx,
            dy,
        }
    }

    fn in_frame(&self, point: Vec3) -> Vec3 {
        let from_eye = point - self.eye;
        vec3(from_eye.dot(self.right), from_eye.dot(self.up), from_eye.dot(self.forward))
    }

    fn on_image(&self, seen: Vec3) -> (f32, f32) {
        (self.centre.0 + self.focal * seen.x / seen.z, self.centre.1 - self.focal * seen.y / seen.z)
    }

    /// The panel's corners in pixels, after clipping at [`NEAR`].
    fn outline(&self, panel: &Panel) -> Vec<(f32, f32)> {
        let corners = panel.corners().map(|corner| self.in_frame(corner));
        let mut outline = Vec::with_capacity(5);
        for (index, &here) in corners.iter().enumerate() {
            let next = corners[(index + 1) % corners.len()];
            if here.z >= NEAR {
                outline.push(self.on_image(here));
            }
            if (here.z >= NEAR) != (next.z >= NEAR) {
                let share = (NEAR - here.z) / (next.z - here.z);
                outline.push(self.on_image(here + (next - here) * share));
            }
        }
        outline
    }
}

/// `at_origin + dx * x + dy * y` for a pixel position `(x, y)`.
#[derive(Clone, Copy)]
pub(super) struct Linear {
    pub at_origin: f32,
    pub dx: f32,
    pub dy: f32,
}

impl Linear {
    #[inline]
    pub fn at(&self, x: f32, y: f32) -> f32 {
        self.at_origin + self.dx * x + self.dy * y
    }

    fn plus(self, other: Linear) -> Linear {
        Linear {
            at_origin: self.at_origin + other.at_origin,
            dx: self.dx + other.dx,
            dy: self.dy + other.dy,
        }
    }

    fn times(self, by: f32) -> Linear {
        Linear { at_origin: self.at_origin * by, dx: self.dx * by, dy: self.dy * by }
    }
}

/// A panel as one camera sees it.
pub(super) struct View {
    /// Per metre; larger is nearer.
    pub inverse_depth: Linear,
    u_over_depth: Linear,
    v_over_depth: Linear,
    /// The point of the panel's plane nearest to the camera, in metres.
    foot: (f32, f32),
    /// One over the camera's distance from the plane.
    per_reach: f32,
    /// Convex polygon in pixels.
    pub outline: Vec<(f32, f32)>,
}

/// What one pixel covers on a panel, in metres.
#[derive(Clone, Copy)]
pub(super) struct Footprint {
    pub u: f32,
    pub v: f32,
    /// Extent of the pixel along `u` and `v`, for filtering textures.
    pub across: f32,
    pub rise: f32,
    /// How far the line of sight moves along `u` and `v` per metre *behind* the panel.
    pub slant: (f32, f32),
    pub depth: f32,
}

impl View {
    /// Surface coordinates at a pixel, in metres.
    #[inline]
    pub fn uv(&self, x: f32, y: f32) -> (f32, f32) {
        let depth = 1.0 / self.inverse_depth.at(x, y);
        (self.u_over_depth.at(x, y) * depth, self.v_over_depth.at(x, y) * depth)
    }

    /// Whether a pixel covers less than `limit` metres along `u`.
    #[inline]
    pub fn is_finer_across(&self, x: f32, y: f32, limit: f32) -> bool {
        self.is_finer(&self.u_over_depth, x, y, limit)
    }

    /// Whether a pixel covers less than `limit` metres along `v`.
    #[inline]
    pub fn is_finer_upwards(&self, x: f32, y: f32, limit: f32) -> bool {
        self.is_finer(&self.v_over_depth, x, y, limit)
    }

    /// The quotient rule on `form / inverse_depth`, multiplied out.
    #[inline]
    fn is_finer(&self, form: &Linear, x: f32, y: f32, limit: f32) -> bool {
        let (value, inverse_depth) = (form.at(x, y), self.inverse_depth.at(x, y));
        let dx = form.dx * inverse_depth - value * self.inverse_depth.dx;
        let dy = form.dy * inverse_depth - value * self.inverse_depth.dy;
        dx.abs() + dy.abs() < limit * inverse_depth * inverse_depth
    }

    #[inline]
    pub fn footprint(&self, x: f32, y: f32) -> Footprint {
        let depth = 1.0 / self.inverse_depth.at(x, y).max(1e-4);
        let u = self.u_over_depth.at(x, y) * depth;
        let v = self.v_over_depth.at(x, y) * depth;
        let extent = |value: f32, form: &Linear| {
            let dx = form.dx - value * self.inverse_depth.dx;
            let dy = form.dy - value * self.inverse_depth.dy;
            (dx.abs() + dy.abs()) * depth
        };
        Footprint {
            u,
            v,
            across: extent(u, &self.u_over_depth).max(1e-4),
            rise: extent(v, &self.v_over_depth).max(1e-4),
            slant: ((u - self.foot.0) * self.per_reach, (v - self.foot.1) * self.per_reach),
            depth,
        }
    }
}
