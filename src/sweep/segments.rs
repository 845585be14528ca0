//! Extrema of h along many segments at once: what stands between receivers and points of a luminaire.

use super::clearance::Clearance;
use super::pack::LANES;
use crate::volume::Lattice;
use glam::DVec3;

/// Up to sixteen segments; lanes that are not used find nothing.
#[repr(C, align(64))]
#[derive(Clone, Debug)]
pub(super) struct Segments {
    /// Where each meets slice 0 of its dominant axis, along the two others, and its steps from slice to slice.
    pub start: [[f32; LANES]; 2],
    pub slope: [[f32; LANES]; 2],
    /// Greatest index of a cell along the two other axes.
    pub last: [[i32; LANES]; 2],
    /// Strides of the two other axes and the dominant one.
    pub stride: [[i32; LANES]; 3],
    /// The same of blocks of [`Clearance`].
    pub blocks: [[i32; LANES]; 3],
    /// First slice, number of slices, all inside Ω, and the way from one to the next: 1 or −1.
    pub first: [i32; LANES],
    pub count: [i32; LANES],
    pub way: [i32; LANES],
    /// h at the ends in Ω, that of the lesser slice first; NaN if it was not asked for.
    pub ends: [[f32; LANES]; 2],
    /// Whether the lesser slice is that of the end.
    falls: [bool; LANES],
    /// Least and greatest h so far.
    pub least: [f32; LANES],
    pub most: [f32; LANES],
    /// Who finds less than the first or as much as the second looks no further.
    pub enough: [[f32; LANES]; 2],
}

impl Segments {
    /// None.
    pub(super) const NONE: Self = Self {
        start: [[0.0; LANES]; 2],
        slope: [[0.0; LANES]; 2],
        last: [[0; LANES]; 2],
        stride: [[0; LANES]; 3],
        blocks: [[0; LANES]; 3],
        first: [0; LANES],
        count: [0; LANES],
        way: [1; LANES],
        ends: [[f32::NAN; LANES]; 2],
        falls: [false; LANES],
        least: [f32::INFINITY; LANES],
        most: [f32::NEG_INFINITY; LANES],
        enough: [[f32::NEG_INFINITY; LANES], [f32::INFINITY; LANES]],
    };

    /// Takes the segment from local `a` to `b` into `lane`, clipped to Ω, with h at its ends; (∞, −∞) if it misses Ω.
    #[inline]
    pub(super) fn set(&mut self, lane: usize, lattice: &Lattice, h: impl Fn(DVec3) -> f32, a: DVec3, b: DVec3) {
        self.place::<false>(lane, lattice, h, a, b);
    }

    /// As [`Segments::set`] to a node, without h at that node itself, from the node on until less than `enough`\[0\] or
    /// as much as `enough`\[1\] is found.
    #[inline]
    pub(super) fn set_before(
        &mut self,
        lane: usize,
        lattice: &Lattice,
        h: impl Fn(DVec3) -> f32,
        [a, node]: [DVec3; 2],
        enough: [f32; 2],
    ) {
        self.place::<true>(lane, lattice, h, a, node);
        (self.enough[0][lane], self.enough[1][lane]) = enough.into();
    }

    /// Gives a lane of [`Segments::set_before`] a value at its node after all: for [`Segments::ranges`].
    #[inline]
    pub(super) fn set_node(&mut self, lane: usize, h: f32) {
        self.ends[usize::from(!self.falls[lane])][lane] = h;
    }

    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_possible_wrap,
        reason = "values are f32, places in the lattice"
    )]
    fn place<const BEFORE: bool>(
        &mut self,
        lane: usize,
        lattice: &Lattice,
        h: impl Fn(DVec3) -> f32,
        a: DVec3,
        b: DVec3,
    ) {
        (self.least[lane], self.most[lane], self.count[lane]) = (f32::INFINITY, f32::NEG_INFINITY, 0);
        let mut ends = [f32::NAN; 2];
        let far = lattice.far();
        let d = b - a;
        let (mut from, mut to) = (0f64, 1f64);
        for x in 0..3 {
            if d[x] == 0.0 {
                if a[x] < 0.0 || a[x] > far[x] {
                    return;
                }
                continue;
            }
            let (t0, t1) = (-a[x] / d[x], (far[x] - a[x]) / d[x]);
            from = from.max(t0.min(t1));
            to = to.min(t0.max(t1));
        }
        if !(from <= to) {
            return;
        }
        // On Ω's faces a segment may enter where its node is, which hides nothing.
        let asked = if !BEFORE { 2 } else { usize::from(from < 1.0 - 1e-9) };
        for (end, t) in ends.iter_mut().zip([from, to]).take(asked) {
            *end = h(a + t * d);
            self.least[lane] = self.least[lane].min(*end);
            self.most[lane] = self.most[lane].max(*end);
        }
        let size = d.abs();
        let axis = if size.z >= size.x && size.z >= size.y { 2 } else { usize::from(size.y >= size.x) };
        self.falls[lane] = d[axis] < 0.0;
        if self.falls[lane] {
            ends.reverse();
        }
        (self.ends[0][lane], self.ends[1][lane]) = ends.into();
        if d[axis] == 0.0 {
            return;
        }
        let dims = lattice.dims();
        let strides = |dims: [usize; 3]| [1, dims[0], dims[0] * dims[1]];
        let (strides, blocks) = (strides(dims), strides(Clearance::blocks(dims)));
        let across = [(axis + 1) % 3, (axis + 2) % 3];
        for (i, &x) in across.iter().enumerate() {
            let slope = d[x] / d[axis];
            self.start[i][lane] = (a[x] - a[axis] * slope) as f32;
            self.slope[i][lane] = slope as f32;
            self.last[i][lane] = dims[x] as i32 - 2;
            (self.stride[i][lane], self.blocks[i][lane]) = (strides[x] as i32, blocks[x] as i32);
        }
        (self.stride[2][lane], self.blocks[2][lane]) = (strides[axis] as i32, blocks[axis] as i32);
        let (p, q) = (a[axis] + from * d[axis], if BEFORE { b[axis] } else { a[axis] + to * d[axis] });
        let (mut first, mut end) =
            (p.min(q).ceil().max(0.0) as i32, (p.max(q).floor() as i32).min(dims[axis] as i32 - 1));
        if BEFORE && d[axis] > 0.0 {
            end -= 1;
        } else if BEFORE {
            first += 1;
        }
        self.count[lane] = (end + 1 - first).max(0);
        (self.first[lane], self.way[lane]) = if BEFORE && d[axis] > 0.0 { (end, -1) } else { (first, 1) };
    }

    /// Takes h of all slices into the extrema, bilinear in each, or of as many as a lane needs to find enough; NaN
    /// counts nothing. `h`: the samples of the fields of [`Segments::set`]. With `clearance`, where h is below the
    /// sweep some slices are left out.
    #[allow(clippy::cast_sign_loss, reason = "strides")]
    pub(super) fn march(&mut self, h: &[f32], clearance: Option<&Clearance>) {
        for lane in 0..LANES {
            let blocks = self.blocks.map(|s| s[lane] as usize);
            let mut step = 0;
            while step < self.count[lane] {
                if self.least[lane] < self.enough[0][lane] || self.most[lane] >= self.enough[1][lane] {
                    break;
                }
                let (value, [i, j, k]) = self.sample(h, lane, step);
                // f32::min and max pass over NaN.
                self.least[lane] = self.least[lane].min(value);
                self.most[lane] = self.most[lane].max(value);
                let [bi, bj, bk] = [i, j, k].map(|x| x >> Clearance::SHIFT);
                let block = bi * blocks[0] + bj * blocks[1] + bk * blocks[2];
                step += clearance.map_or(1, |clearance| i32::from(clearance.slices[block]));
            }
        }
    }

    /// h in a slice of a lane, bilinear, and the cell there by the two other axes and the slice.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn sample(&self, h: &[f32], lane: usize, step: i32) -> (f32, [usize; 3]) {
        let stride = self.stride.map(|s| s[lane] as usize);
        let k = self.first[lane] + step * self.way[lane];
        let x = [0, 1].map(|i| (self.start[i][lane] + k as f32 * self.slope[i][lane]).max(0.0));
        let cell = [0, 1].map(|i| (x[i] as i32).min(self.last[i][lane]));
        let [f, g] = [0, 1].map(|i| (x[i] - cell[i] as f32).min(1.0));
        let [i, j, k] = [cell[0], cell[1], k].map(|x| x as usize);
        let at = i * stride[0] + j * stride[1] + k * stride[2];
        let line = |at: usize| h[at] + f * (h[at + stride[0]] - h[at]);
        let (near, far) = (line(at), line(at + stride[1]));
        (near + g * (far - near), [i, j, k])
    }

    /// What h spans along a lane, from one gap of samples that are not finite to the next, in the order of its slices.
    /// It falls to −∞ at caps, where the segment enters and leaves Ω if `caps` says so.
    pub(super) fn ranges(&self, h: &[f32], lane: usize, mut caps: [bool; 2]) -> Vec<[f32; 2]> {
        let slices = (0..self.count[lane]).map(|step| self.sample(h, lane, step).0);
        if self.falls[lane] {
            caps.reverse();
        }
        let mut ends = self.ends.each_ref().map(|h| h[lane]);
        // From the node on, which is where it ends.
        if self.way[lane] < 0 {
            ends.reverse();
            caps.reverse();
        }
        let [before, behind] = ends;
        let mut ranges = vec![];
        let [enters, leaves] = [(caps[0], before), (caps[1], behind)].map(|(cap, h)| cap && !h.is_nan());
        let mut gap = true;
        for h in std::iter::once(before).chain(slices).chain([behind]) {
            if h.is_nan() {
                gap = true;
                continue;
            }
            if gap {
                ranges.push([f32::INFINITY, f32::NEG_INFINITY]);
            }
            if let Some([least, most]) = ranges.last_mut() {
                (*least, *most) = (least.min(h), most.max(h));
            }
            gap = false;
        }
        if let (true, Some(range)) = (enters, ranges.first_mut()) {
            range[0] = f32::NEG_INFINITY;
        }
        if let (true, Some(range)) = (leaves, ranges.last_mut()) {
            range[0] = f32::NEG_INFINITY;
        }
        ranges
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::rng::{Rng, Stage};
    use crate::volume::{Samples, Volume};

    fn field(dims: [usize; 3], h: impl FnMut(DVec3) -> f64) -> Field {
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let place = |o| lattice.point(o);
        let samples = (0..lattice.len()).map(place).map(h).collect();
        let volume = Volume::new("known", lattice, Samples::F64(samples)).unwrap();
        Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap()
    }

    /// On noise: the trilinear field itself, asked at every slice and at the ends.
    #[test]
    fn extrema_are_those_of_the_field_at_every_slice() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let noise = field([12, 9, 15], |_| rng.unit());
        let far = noise.lattice().far();
        let mut rng = Rng::stream(2, Stage::Test, 0);
        for _ in 0..200 {
            let mut segments = Segments::NONE;
            let ends: [[DVec3; 2]; LANES] =
                std::array::from_fn(|_| [0, 1].map(|_| DVec3::new(rng.unit(), rng.unit(), rng.unit()) * far));
            ends.iter()
                .enumerate()
                .for_each(|(lane, e)| segments.set(lane, noise.lattice(), |p| noise.value(p) as f32, e[0], e[1]));
            segments.march(noise.samples(), None);
            for (lane, [a, b]) in ends.into_iter().enumerate() {
                let d = b - a;
                let axis = d.abs().to_array().iter().position(|x| *x == d.abs().max_element()).unwrap();
                let slices = (0..=far[axis] as usize).map(|k| (k as f64 - a[axis]) / d[axis]);
                let at = slices.filter(|t| (0.0..=1.0).contains(t)).chain([0.0, 1.0]);
                let values: Vec<f64> = at.map(|t| noise.value(a + t * d)).collect();
                let [lo, hi] = [f64::min, f64::max].map(|f| values.iter().copied().reduce(f).unwrap());
                let off = (f64::from(segments.least[lane]) - lo).abs().max((f64::from(segments.most[lane]) - hi).abs());
                assert!(off < 1e-5, "{a} to {b}: {off}");
            }
        }
    }

    /// From nodes of noise to points around: whether all is below or none, told from the slices that are needed, is
    /// what all of them tell, and the first ones beside the node are enough to tell that something is there.
    #[test]
    fn who_has_found_enough_looks_no_further() {
        let mut rng = Rng::stream(4, Stage::Test, 0);
        let noise = field([12, 9, 15], |_| rng.unit());
        let mut rng = Rng::stream(5, Stage::Test, 0);
        let mut told = [0; 2];
        for _ in 0..200 {
            let mut point = || DVec3::new(rng.unit(), rng.unit(), rng.unit());
            let node = (point() * noise.lattice().far()).round();
            let ends: [DVec3; LANES] = std::array::from_fn(|_| node + 12.0 * (point() - 0.5));
            let h = noise.value(node) as f32;
            let marched = |enough| {
                let mut segments = Segments::NONE;
                let h = |p: DVec3| noise.value(p) as f32;
                let set =
                    |(lane, y): (usize, &DVec3)| segments.set_before(lane, noise.lattice(), h, [*y, node], enough);
                ends.iter().enumerate().for_each(set);
                segments.march(noise.samples(), None);
                segments
            };
            let all = marched([f32::NEG_INFINITY, f32::INFINITY]);
            let [lower, higher] = [marched([f32::NEG_INFINITY, h]), marched([h, f32::INFINITY])];
            for (lane, end) in ends.into_iter().enumerate() {
                assert_eq!(lower.most[lane] < h, all.most[lane] < h, "lower side");
                assert_eq!(higher.least[lane] >= h, all.least[lane] >= h, "higher side");
                told[0] += usize::from(all.most[lane] >= h && lower.most[lane] < all.most[lane]);
                // In the slice next to the node, if not at the other end.
                let slices = |count: i32| {
                    let mut first = Segments::NONE;
                    let h = |p: DVec3| noise.value(p) as f32;
                    first.set_before(0, noise.lattice(), h, [end, node], [f32::NEG_INFINITY, f32::INFINITY]);
                    first.count[0] = first.count[0].min(count);
                    first.march(noise.samples(), None);
                    first.most[0]
                };
                let d = node - end;
                let beside = noise.value(node - d / d.abs().max_element()) as f32;
                if slices(0) < h && beside >= h && lower.count[lane] > 0 {
                    assert!((lower.most[lane] - beside).abs() < 1e-5 && (slices(1) - beside).abs() < 1e-5);
                    told[1] += 1;
                }
            }
        }
        assert!(told[0] > 500 && told[1] > 200, "{told:?}");
    }

    /// Through noise with gaps, both ways: the spans of the samples from one gap to the next.
    #[test]
    fn ranges_end_at_gaps() {
        let mut rng = Rng::stream(6, Stage::Test, 0);
        let noise = field([12, 9, 15], |_| if rng.unit() < 0.05 { f64::NAN } else { rng.unit() });
        let far = noise.lattice().far();
        let mut rng = Rng::stream(7, Stage::Test, 0);
        let mut parts = [0; 3];
        for _ in 0..500 {
            let [a, b] = [0, 1].map(|_| DVec3::new(rng.unit(), rng.unit(), rng.unit()) * far);
            let mut segments = Segments::NONE;
            segments.set(5, noise.lattice(), |p| noise.value(p) as f32, a, b);
            let found = segments.ranges(noise.samples(), 5, [false; 2]);
            let caps = [rng.unit() < 0.5, rng.unit() < 0.5];
            let capped = segments.ranges(noise.samples(), 5, caps);
            let d = b - a;
            let axis = d.abs().to_array().iter().position(|x| *x == d.abs().max_element()).unwrap();
            let slices = (0..=far[axis] as usize).map(|k| (k as f64 - a[axis]) / d[axis]);
            let inside = slices.filter(|t| (0.0..=1.0).contains(t)).map(|t| {
                // In a slice, whatever the cells beside it hold.
                let x = a + t * d;
                let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
                let corner = |n: usize| {
                    let mut node = x.round();
                    node[u] = x[u].floor().min(far[u] - 1.0) + (n % 2) as f64;
                    node[v] = x[v].floor().min(far[v] - 1.0) + (n / 2) as f64;
                    let [i, j, k] = node.to_array().map(|x| x as usize);
                    f64::from(noise.samples()[noise.lattice().offset(i, j, k)])
                };
                let [f, g] = [u, v].map(|a| x[a] - x[a].floor().min(far[a] - 1.0));
                (1.0 - g) * ((1.0 - f) * corner(0) + f * corner(1)) + g * ((1.0 - f) * corner(2) + f * corner(3))
            });
            // In rising order of slices, whichever way the segment runs.
            let mut values: Vec<f64> = inside.collect();
            values.insert(0, noise.value(if d[axis] > 0.0 { a } else { b }));
            values.push(noise.value(if d[axis] > 0.0 { b } else { a }));
            let expected: Vec<&[f64]> = values.split(|h| h.is_nan()).filter(|part| !part.is_empty()).collect();
            assert_eq!(found.len(), expected.len(), "{a} to {b}: {found:?}, {values:?}");
            for ([least, most], part) in found.iter().zip(&expected) {
                let [lo, hi] = [f64::min, f64::max].map(|f| part.iter().copied().reduce(f).unwrap());
                assert!((f64::from(*least) - lo).abs() < 1e-5 && (f64::from(*most) - hi).abs() < 1e-5, "{a} to {b}");
            }
            parts[expected.len().min(2)] += 1;
            let caps = if d[axis] > 0.0 { caps } else { [caps[1], caps[0]] };
            let ends = [(caps[0], 0, values[0]), (caps[1], found.len().saturating_sub(1), values[values.len() - 1])];
            for (n, (capped, found)) in capped.iter().zip(&found).enumerate() {
                let falls = ends.iter().any(|(cap, at, h)| *cap && *at == n && !h.is_nan());
                assert_eq!(capped[1], found[1]);
                assert_eq!(capped[0], if falls { f32::NEG_INFINITY } else { found[0] }, "{a} to {b}: {n}");
            }
        }
        assert!(parts[1] > 50 && parts[2] > 100, "{parts:?}");
    }

    /// A segment that runs from outside through a ramp, and one that misses it.
    #[test]
    fn segments_are_clipped() {
        let ramp = field([11; 3], |x| x.x / 10.0);
        let mut segments = Segments::NONE;
        let h = |p: DVec3| ramp.value(p) as f32;
        segments.set(0, ramp.lattice(), h, DVec3::new(-5.0, 2.0, 3.0), DVec3::new(7.5, 4.0, 3.0));
        segments.set(1, ramp.lattice(), h, DVec3::new(-5.0, 2.0, 3.0), DVec3::new(-1.0, 9.0, 9.0));
        segments.march(ramp.samples(), None);
        assert!((segments.least[0]).abs() < 1e-6 && (segments.most[0] - 0.75).abs() < 1e-6);
        for lane in 1..LANES {
            assert_eq!((segments.least[lane], segments.most[lane]), (f32::INFINITY, f32::NEG_INFINITY));
        }
    }
}
