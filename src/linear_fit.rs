//! A weighted linear function fitted to values in space, evaluated at its origin. \[Loader99\]

use glam::{DMat4, DVec4, Vec3};

/// Prior weight of "no slope", as a share of what full coverage of the unit ball says.
const RIDGE: f64 = 0.05;

/// Σ w (1, d)(1, d)ᵀ over places d in the unit ball: 1, d, d dᵀ as xx, yy, zz, xy, xz, yz.
#[derive(Clone, Copy, Debug, Default)]
pub struct Moments([f32; 10]);

impl Moments {
    /// Adds a place of weight `w`.
    #[inline]
    pub fn add(&mut self, w: f32, d: Vec3) {
        let terms = [1.0, d.x, d.y, d.z, d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.x * d.z, d.y * d.z];
        self.0.iter_mut().zip(terms).for_each(|(m, t)| *m += w * t);
    }

    /// Σ w.
    #[inline]
    pub fn weight(&self) -> f32 {
        self.0[0]
    }

    /// The symmetric matrix.
    pub fn matrix(&self) -> DMat4 {
        let m = self.0.map(f64::from);
        DMat4::from_cols(
            DVec4::new(m[0], m[1], m[2], m[3]),
            DVec4::new(m[1], m[4], m[7], m[8]),
            DVec4::new(m[2], m[7], m[5], m[9]),
            DVec4::new(m[3], m[8], m[9], m[6]),
        )
    }

    /// The symmetric matrix whose product with Σ w v (1, d) is the fit's value at d = 0 and its slope; of no use if
    /// [`Moments::weight`] is 0.
    pub fn inverse(&self) -> DMat4 {
        // ∫K d_x² / ∫K over the ball is 1/7 for Epanechnikov's kernel. [Silverman86]
        let ridge = DVec4::new(0.0, 1.0, 1.0, 1.0) * (RIDGE / 7.0 * f64::from(self.0[0]));
        (self.matrix() + DMat4::from_diagonal(ridge)).inverse()
    }

    /// The first row of [`Moments::inverse`]: the value at d = 0.
    pub fn at_origin(&self) -> DVec4 {
        self.inverse().x_axis
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_function_is_found_from_one_side_of_it() {
        let f = |d: Vec3| 2.0 + d.x - 0.5 * d.y + 3.0 * d.z;
        let (mut moments, mut sums) = (Moments::default(), DVec4::ZERO);
        for i in 0..1000 {
            // Places in one octant only.
            let d = Vec3::new((i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32) / 16.0;
            let w = 1.0 - d.length_squared();
            moments.add(w, d);
            sums += f64::from(w * f(d)) * DVec4::new(1.0, d.x.into(), d.y.into(), d.z.into());
        }
        let fitted = moments.at_origin().dot(sums);
        let mean = sums.x / f64::from(moments.weight());
        // The prior, strong for places so close together, leaves a fifth of what the mean is off.
        assert!((mean - 2.0).abs() > 0.5 && (fitted - 2.0).abs() < 0.2 * (mean - 2.0).abs(), "{fitted}, {mean}");
    }
}
