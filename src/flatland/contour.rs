//! Level curves as line segments (marching squares on bilinear cells), for drawings and for samples along them.

use super::HeightField;
use glam::DVec2;

/// Segments of L(h, c) in index coordinates, c in units of the sweep. In a saddle cell h at the saddle decides which
/// corners join \[NH91\]. Chords of the curve: ends are exact on the cells' edges.
pub(super) fn level_curve(field: &HeightField, c: f64) -> Vec<[DVec2; 2]> {
    let [nx, ny] = field.dims();
    let mut segments = Vec::new();
    for j in 0..ny - 1 {
        for i in 0..nx - 1 {
            let s = field.corners([i, j]).map(f64::from);
            if s.iter().any(|v| v.is_nan()) {
                continue;
            }
            // Around the cell: corner and the way to the next.
            let ring = [(s[0], DVec2::ZERO), (s[1], DVec2::X), (s[3], DVec2::ONE), (s[2], DVec2::Y)];
            let mut cuts: Vec<DVec2> = Vec::with_capacity(4);
            for k in 0..4 {
                let ((a, p), (b, q)) = (ring[k], ring[(k + 1) % 4]);
                if (a >= c) != (b >= c) {
                    cuts.push(DVec2::new(i as f64, j as f64) + p.lerp(q, ((c - a) / (b - a)).clamp(0.0, 1.0)));
                }
            }
            match cuts[..] {
                [a, b] => segments.push([a, b]),
                [a, b, d, e] => {
                    // Cuts 0 and 1 enclose corner 1: they join if that corner stands alone.
                    let saddle = (s[0] * s[3] - s[1] * s[2]) / (s[0] + s[3] - s[1] - s[2]);
                    if (s[1] >= c) == (saddle >= c) {
                        segments.extend([[a, e], [b, d]]);
                    } else {
                        segments.extend([[a, b], [d, e]]);
                    }
                }
                _ => {}
            }
        }
    }
    segments
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;

    #[test]
    fn curves_lie_on_their_level_and_close() {
        let field = HeightField::generate("bumps2", 65, Sweep::new(3.6, 95.0).unwrap()).unwrap();
        for c in [0.05, 0.3, 0.6, 0.9] {
            let segments = level_curve(&field, c);
            let mut ends: Vec<[u64; 2]> = Vec::new();
            for p in segments.iter().flatten() {
                assert!((field.value(*p) - c).abs() < 1e-6, "{p}: {}", field.value(*p));
                ends.push([(p.x * 1e6).round() as u64, (p.y * 1e6).round() as u64]);
            }
            ends.sort_unstable();
            assert!(!ends.is_empty() && ends.chunks(2).all(|e| e[0] == e[1]), "every end is the end of two segments");
        }
    }

    #[test]
    fn saddles_join_the_way_their_value_says() {
        let sweep = Sweep::new(0.0, 1.0).unwrap();
        for (values, c, joined) in [
            ([1.0, 0.0, 0.0, 1.0], 0.5, true),
            ([0.9, 0.0, 0.0, 0.9], 0.5, false),
            // 0.232 at the saddle, 0.325 in the middle.
            ([1.0, 0.0, 0.0, 0.302], 0.25, false),
            ([1.0, 0.0, 0.0, 0.302], 0.22, true),
        ] {
            let field = HeightField::new([2, 2], DVec2::ZERO, DVec2::ONE, &values, sweep).unwrap();
            // At the saddle 0.5 or 0.45 against c = 0.5: the high corners are one region, or two.
            let segments = level_curve(&field, c);
            let around_low = segments.iter().any(|[a, b]| {
                let m = 0.5 * (*a + *b);
                m.x > 0.5 && m.y < 0.5 && m.x - m.y > 0.4
            });
            assert_eq!((segments.len(), around_low), (2, joined), "{segments:?}");
        }
    }
}
