//! Normals in 32 bits, as the hot loops read them: x and y in 11 bits each, z in 10. 0 is none.

use glam::DVec3;

/// What the greatest of x, y and z is scaled to.
const GREATEST: f64 = 1022.0;

/// The direction of `v`, to less than 0.1 degrees; 0 if `v` is 0 or not finite.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "scaled to the bits there are")]
pub(super) fn encode(v: DVec3) -> u32 {
    let scale = v.abs().max_element();
    if !(scale > 0.0 && scale.is_finite()) {
        return 0;
    }
    let v = v / scale * GREATEST;
    let [x, y, z] = [v.x, v.y, 0.5 * v.z].map(|x| x.round() as i32 as u32);
    x & 0x7ff | (y & 0x7ff) << 11 | z << 22
}

/// A vector of that direction, of any length.
#[inline(always)]
pub(super) fn decode(normal: u32) -> [f32; 3] {
    let bits = normal.cast_signed();
    [(bits << 21 >> 21) as f32, (bits << 10 >> 21) as f32, (bits >> 22 << 1) as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};
    use crate::warp::sphere;

    #[test]
    fn normals_survive_to_a_tenth_of_a_degree() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let mut sum = 0.0;
        for _ in 0..100_000 {
            let n = sphere(rng.unit2());
            let packed = encode(n * 1e-200);
            let back = DVec3::from_array(decode(packed).map(f64::from)).normalize();
            let angle = back.cross(n).length();
            assert!(packed != 0 && angle < 0.1f64.to_radians(), "{n} {back}");
            // The other way round it is the same.
            assert_eq!(decode(encode(-n)).map(|x| -x), decode(packed));
            sum += angle * angle;
        }
        let rms = (sum / 1e5).sqrt();
        assert!(rms < 7e-4, "{rms}");
    }

    #[test]
    fn axes_are_exact_and_nothing_is_none() {
        for axis in DVec3::AXES {
            for n in [axis, -axis] {
                assert_eq!(decode(encode(n)), (n * GREATEST).as_vec3().to_array());
            }
        }
        for v in [DVec3::ZERO, DVec3::NAN, DVec3::new(1.0, f64::INFINITY, 0.0)] {
            assert_eq!(encode(v), 0, "{v}");
        }
    }
}
