//! A weighted linear function fitted to values in space, evaluated at its origin. \[Loader99\]

use glam::{DMat4, DVec3, DVec4, Vec3, Vec4};

/// Prior weight of "no slope", as a share of what full coverage of the unit ball says.
const RIDGE: f64 = 0.05;

/// Σ w (1, d)(1, d)ᵀ over places d in the unit ball, by column.
#[derive(Clone, Copy, Debug, Default)]
pub struct NormalMatrix([Vec4; 4]);

/// Σ w v (1, d) of values v there, by channel.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sums([Vec4; 3]);

/// (1, d)
#[inline(always)]
fn terms(d: Vec3) -> Vec4 {
    Vec4::new(1.0, d.x, d.y, d.z)
}

impl NormalMatrix {
    /// Adds a place of weight `w`.
    #[inline(always)]
    pub fn add(&mut self, w: f32, d: Vec3) {
        let terms = w * terms(d);
        self.0[0] += terms;
        self.0[1] += terms * d.x;
        self.0[2] += terms * d.y;
        self.0[3] += terms * d.z;
    }

    /// Σ w.
    #[inline]
    pub fn weight(&self) -> f32 {
        self.0[0].x
    }

    /// The symmetric matrix whose product with [`Sums`] is the fit's value at d = 0 and its slope; of no use if
    /// [`NormalMatrix::weight`] is 0.
    pub fn inverse(&self) -> DMat4 {
        // ∫K d_x² / ∫K over the ball is 1/7 for Epanechnikov's kernel. [Silverman86]
        let ridge = DVec4::new(0.0, 1.0, 1.0, 1.0) * (RIDGE / 7.0 * f64::from(self.weight()));
        let [a, b, c, d] = self.0.map(|column| column.as_dvec4());
        (DMat4::from_cols(a, b, c, d) + DMat4::from_diagonal(ridge)).inverse()
    }

    /// The first row of [`NormalMatrix::inverse`]: the value at d = 0.
    pub fn at_origin(&self) -> DVec4 {
        self.inverse().x_axis
    }
}

impl Sums {
    /// Adds a place's value times its weight.
    #[inline(always)]
    pub fn add(&mut self, value: Vec3, d: Vec3) {
        let terms = terms(d);
        self.0.iter_mut().zip(value.to_array()).for_each(|(sum, v)| *sum += v * terms);
    }

    /// Σ w v.
    pub fn total(&self) -> Vec3 {
        Vec3::from_array(self.0.map(|sum| sum.x))
    }

    /// What a row `g` of [`NormalMatrix::inverse`] makes of them: the fit's value, or one of its slopes.
    #[inline]
    pub fn fitted(&self, g: DVec4) -> DVec3 {
        DVec3::from_array(self.0.map(|sum| g.dot(sum.as_dvec4())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_function_is_found_from_one_side_of_it() {
        let f = |d: Vec3| 2.0 + d.x - 0.5 * d.y + 3.0 * d.z;
        let (mut matrix, mut sums) = (NormalMatrix::default(), Sums::default());
        for i in 0..1000 {
            // Places in one octant only.
            let d = Vec3::new((i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32) / 16.0;
            let w = 1.0 - d.length_squared();
            matrix.add(w, d);
            sums.add(w * Vec3::new(f(d), 1.0, 0.0), d);
        }
        let fitted = sums.fitted(matrix.at_origin());
        assert!((fitted.y - 1.0).abs() < 1e-5 && fitted.z == 0.0, "{fitted}");
        let (fitted, mean) = (fitted.x as f32, sums.total().x / matrix.weight());
        // The prior, strong for places so close together, leaves a fifth of what the mean is off.
        assert!((mean - 2.0).abs() > 0.5 && (fitted - 2.0).abs() < 0.2 * (mean - 2.0).abs(), "{fitted}, {mean}");
    }
}
