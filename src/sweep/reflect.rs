//! What nodes reflect, as lines read it.

use super::Run;
use super::flats::Flats;
use super::half::{self, Half4};
use super::lit_rows::LitRows;
use super::planes::NodeLight;
use super::settling::Sums;
use glam::DVec3;
use rayon::prelude::*;

/// Light is blurred on its way from nodes to nodes. If what counts as the light at x comes from x + δ, its mean over
/// all x is E + ½⟨δ²⟩E″ along every axis: too bright in hollows, where the next bounce carries it on. What a line reads
/// at a hit is one of the four nodes around it on the nearer slice: about E″/12 along both axes of the slice and E″/24
/// along the line, with every axis in turn across.
const READING: f32 = 5.0 / 72.0;

/// A node's own light comes from the four lines around it, by bilinear weights: E″/12 along both axes of its slice.
/// What a luminaire's lines see, too.
pub(super) const RECEIVING: f32 = 1.0 / 18.0;

/// So much of its second differences is taken off what nodes reflect. \[Condat05\]
pub(super) const SHARPENING: f32 = READING + RECEIVING;

/// What nodes reflect.
#[derive(Debug)]
pub(super) struct Reflected {
    /// Per side, times `unit`.
    pub b: Vec<Vec<Half4>>,
    pub unit: f32,
}

impl Default for Reflected {
    fn default() -> Self {
        Self { b: Vec::new(), unit: 1.0 }
    }
}

impl Run<'_> {
    /// Which nodes of a row along x have light of their own to reflect: 1, the others 0.
    fn shown(&self, row: usize, to: &mut Vec<f32>) {
        let nx = self.geometry.dims[0];
        let nodes = row * nx..(row + 1) * nx;
        to.clear();
        to.resize(nx, 0.0);
        let (first, run) = self.geometry.lit_rows().run(row);
        let normals = &self.geometry.normals[run];
        to[first..].iter_mut().zip(normals).for_each(|(to, n)| *to = if *n != 0 { 1.0 } else { 0.0 });
        let hidden = &self.slits.hidden;
        let first = hidden.partition_point(|h| h.0 < nodes.start);
        hidden[first..].iter().take_while(|h| h.0 < nodes.end).for_each(|h| to[h.0 - nodes.start] = 0.0);
    }

    /// The channels in which nodes reflect nothing.
    pub(super) fn black(&self) -> [bool; 3] {
        let stops = self.scene.surface.albedo.stops();
        std::array::from_fn(|c| stops.iter().all(|stop| stop.1[c] == 0.0))
    }

    /// B = Le + ρ/π Σ scale · irradiance of the sides, sharpened, and filled where no surface is; packs the flats too.
    /// `light`: sets of irradiance, each with its scale. `memory`: B that is no longer needed and is written over;
    /// empty at first. `relaxed`: while light settles, what the pass read, and ω ≥ 1 per channel: the result goes ω
    /// times as far from what `memory` held. `sharpening`: [`SHARPENING`], or less. Returns sums of B itself, too.
    #[allow(clippy::cast_possible_truncation, reason = "albedo and emission")]
    pub(super) fn reflected(
        &self,
        flats: &mut Flats,
        light: &[(NodeLight, f32)],
        memory: Reflected,
        relaxed: Option<(&Reflected, [f32; 3])>,
        sharpening: f32,
    ) -> (Reflected, Sums) {
        let surface = &self.scene.surface;
        let over_pi =
            |albedo: DVec3| -> [f32; 3] { std::array::from_fn(|c| (albedo[c] / std::f64::consts::PI) as f32) };
        // Of every stop: also a bound for nodes just outside the sweep.
        let greatest = over_pi(surface.albedo.stops().iter().fold(DVec3::ZERO, |m, s| m.max(s.1)));
        let by_node: Option<Vec<[f32; 3]>> = (surface.albedo.stops().len() > 1).then(|| {
            let h = self.geometry.h.par_iter().with_min_len(1 << 12);
            h.map(|&h| over_pi(surface.albedo.at(f64::from(h)))).collect()
        });
        let emission = surface.emission.as_vec3().to_array();
        let omega = relaxed.map_or([1.0; 3], |r| r.1);
        let mut most = flats.greatest();
        let sides = light[0].0.sides();
        for s in 0..sides {
            for c in 0..3 {
                let e: f32 = light.iter().map(|(light, scale)| scale * light.greatest(s, c)).sum();
                most = most.max(omega[c] * (emission[c] + greatest[c] * e * (1.0 + 6.0 * SHARPENING)));
            }
        }
        let unit = half::scale(most);
        flats.pack(unit);
        let [nx, ny, nz] = self.geometry.dims;
        let n = nx * ny * nz;
        let job = RowJob {
            light,
            lit: self.geometry.lit_rows(),
            emission: emission.map(|e| unit * e),
            over_pi: greatest.map(|rho| unit * rho),
            by_node: by_node.as_deref(),
            unit,
            old: relaxed.map(|(old, _)| (old, unit / old.unit)),
            omega,
            memory: unit / memory.unit,
            sharpening,
        };
        let mut memory = memory.b.into_iter();
        let mut sums = Sums::default();
        let b = (0..sides).map(|s| {
            // Memory is black where nothing is ever shown, and stays untouched.
            let old = memory.next();
            let new = old.is_none();
            let mut b = old.unwrap_or_else(|| vec![[0; 4]; n]);
            let rows =
                b.par_chunks_mut(nx).enumerate().with_max_len(64).map_init(RowScratch::default, |rows, (row, b)| {
                    if !self.geometry.shows(row) {
                        return Sums::default();
                    }
                    let (j, k) = (row % ny, row / ny);
                    let beside = [
                        Some(row),
                        (j > 0).then(|| row - 1),
                        (j + 1 < ny).then_some(row + 1),
                        (k > 0).then(|| row - ny),
                        (k + 1 < nz).then_some(row + ny),
                    ];
                    let shown = &mut rows.shown;
                    self.shown(row, &mut shown[0]);
                    if !shown[0].contains(&1.0) {
                        if !new {
                            b.fill([0; 4]);
                        }
                        return Sums::default();
                    }
                    for (shown, row) in shown.iter_mut().zip(beside).skip(1) {
                        match row {
                            Some(row) => self.shown(row, shown),
                            None => shown.clear(),
                        }
                    }
                    self.isa.reflect(&job, s, beside, rows, b)
                });
            // Added up row after row: the same bits on any number of threads.
            let rows: Vec<Sums> = rows.collect();
            rows.iter().for_each(|row| sums.add(row, 1.0 / f64::from(unit)));
            for &(node, front) in &self.slits.hidden {
                b[node] = b[front];
            }
            self.geometry.fill(&mut b);
            b
        });
        let b = b.collect();
        (Reflected { b, unit }, sums)
    }
}

/// A row of nodes and the four beside it, which are empty where there is none.
type Cross = [Vec<f32>; 5];

/// Rows of nodes at work.
#[derive(Default)]
pub(super) struct RowScratch {
    shown: Cross,
    light: Cross,
    laplacian: Vec<f32>,
    /// What the row reflects, per channel, times the unit.
    reflected: [Vec<f32>; 3],
}

/// What is done to every row of nodes.
pub(super) struct RowJob<'a> {
    light: &'a [(NodeLight<'a>, f32)],
    lit: &'a LitRows,
    /// Times the unit.
    emission: [f32; 3],
    /// ρ/π, times the unit; where it differs from node to node, as it is.
    over_pi: [f32; 3],
    by_node: Option<&'a [[f32; 3]]>,
    unit: f32,
    /// What the pass read, and what makes it of this unit.
    old: Option<(&'a Reflected, f32)>,
    omega: [f32; 3],
    /// What makes `b` as it was of this unit.
    memory: f32,
    sharpening: f32,
}

/// What nodes of a row reflect on side `s`, into `b`. `beside` are the numbers of the row and of those around it, of
/// which `rows` tell what is shown.
#[inline(always)]
pub(super) fn reflect_row(
    job: &RowJob,
    s: usize,
    beside: [Option<usize>; 5],
    rows: &mut RowScratch,
    b: &mut [Half4],
) -> Sums {
    let nx = b.len();
    let first = beside[0].map_or(0, |row| row * nx);
    let RowScratch { shown, light, laplacian, reflected } = rows;
    for c in 0..3 {
        for (to, row) in light.iter_mut().zip(beside) {
            to.clear();
            if let Some(row) = row {
                to.resize(nx, 0.0);
                let (first, run) = job.lit.run(row);
                let to = &mut to[first..first + run.len()];
                job.light.iter().for_each(|(light, scale)| light.add((s, c), *scale, run.start, to));
            }
        }
        sharpen(light, shown, laplacian, job.sharpening);
        reflected[c].clear();
        reflected[c].extend_from_slice(&light[0]);
        let (y, is) = (&mut reflected[c][..nx], &shown[0][..nx]);
        let le = job.emission[c];
        if let Some(by_node) = job.by_node {
            let by_node = &by_node[first..][..nx];
            for i in 0..nx {
                y[i] = is[i] * (le + job.unit * by_node[i][c] * y[i]);
            }
        } else {
            for i in 0..nx {
                y[i] = is[i] * (le + job.over_pi[c] * y[i]);
            }
        }
    }
    let mut sums = Sums::default();
    let [r, g, blue] = reflected;
    let y = [&r[..nx], &g[..nx], &blue[..nx]];
    sums.light = [0, 1, 2].map(|c| sum(y[c]));
    if let Some((old, scale)) = job.old {
        let old = &old.b[s][first..][..nx];
        for c in 0..3 {
            (sums.change[c], sums.drift[c]) = changed(y[c], &shown[0], laplacian, |i| scale * half::decode(old[i][c]));
        }
    }
    if job.omega == [1.0; 3] {
        for i in 0..nx {
            b[i] = [half::encode(y[0][i]), half::encode(y[1][i]), half::encode(y[2][i]), 0];
        }
        return sums;
    }
    for i in 0..nx {
        let next = |c: usize| {
            let before = job.memory * half::decode(b[i][c]);
            half::encode((before + job.omega[c] * (y[c][i] - before)).max(0.0))
        };
        b[i] = [next(0), next(1), next(2), 0];
    }
    sums
}

/// Partial sums, so that vectors can be added.
const PARTS: usize = 8;

/// Σ x.
#[inline(always)]
fn sum(x: &[f32]) -> f64 {
    let (whole, rest) = x.as_chunks::<PARTS>();
    let mut parts = [0f64; PARTS];
    for x in whole {
        for i in 0..PARTS {
            parts[i] += f64::from(x[i]);
        }
    }
    parts.iter().sum::<f64>() + rest.iter().map(|x| f64::from(*x)).sum::<f64>()
}

/// Σ|y − x| and Σ(y − x) over nodes that are shown; y as it will be kept.
#[inline(always)]
fn changed(y: &[f32], shown: &[f32], change: &mut Vec<f32>, x: impl Fn(usize) -> f32) -> (f64, f64) {
    let n = y.len();
    change.clear();
    change.resize(n, 0.0);
    let (change, shown) = (&mut change[..n], &shown[..n]);
    for i in 0..n {
        change[i] = shown[i] * (half::decode(half::encode(y[i])) - x(i));
    }
    let drift = sum(change);
    change.iter_mut().for_each(|x| *x = x.abs());
    (sum(change), drift)
}

/// Sharpens the first row of irradiance, against its neighbours that are shown.
#[inline(always)]
fn sharpen(light: &mut Cross, shown: &Cross, laplacian: &mut Vec<f32>, sharpening: f32) {
    let ([here, beside @ ..], [is, is_beside @ ..]) = (light, shown);
    let nx = here.len();
    laplacian.clear();
    laplacian.resize(nx, 0.0);
    for i in 1..nx {
        let d = here[i] - here[i - 1];
        laplacian[i - 1] += is[i] * d;
        laplacian[i] -= is[i - 1] * d;
    }
    for (other, is) in beside.iter().zip(is_beside) {
        for (((sum, e), here), is) in laplacian.iter_mut().zip(other).zip(&*here).zip(is) {
            *sum += is * (e - here);
        }
    }
    here.iter_mut().zip(laplacian).for_each(|(e, l)| *e = (*e - sharpening * *l).max(0.0));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isa::Isa;
    use crate::rng::{Rng, Stage};
    use crate::sweep::blocks::Blocks;
    use crate::sweep::planes::HalfPlanes;

    /// Of a field whose second differences are known: read as lines do, for a node that takes four lines, it is itself
    /// on average over places that begin and end nowhere. Without sharpening the mean would be off by 0.25.
    #[test]
    fn nodes_receive_on_average_what_is_there() {
        let n = 17;
        let at = |x: DVec3| {
            let x = x - 8.0;
            100.0 + x.x * x.x - 2.0 * x.y * x.y + 2.0 * x.z * x.z + x.x * x.y - 0.5 * x.z
        };
        let place = |o: usize| DVec3::new((o % n) as f64, (o / n % n) as f64, (o / n / n) as f64);
        let field: Vec<f32> = (0..n * n * n).map(|o| at(place(o)) as f32).collect();
        let shown: Cross = std::array::from_fn(|_| vec![1.0; n]);
        let sharp: Vec<f32> = (0..n * n)
            .flat_map(|row| {
                let (j, k) = (row % n, row / n);
                let inside = (1..n - 1).contains(&j) && (1..n - 1).contains(&k);
                let read = |row: usize| field[row * n..][..n].to_vec();
                let mut light = [row, row - row.min(1), row + 1, row - row.min(n), row + n]
                    .map(|row| if inside { read(row) } else { Vec::new() });
                light[0] = read(row);
                sharpen(&mut light, &shown, &mut Vec::new(), SHARPENING);
                light[0].clone()
            })
            .collect();
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let mut sum = 0.0;
        let count = 1_000_000;
        for _ in 0..count {
            // Cubic B-splines: whoever looks at half a voxel more sees as much.
            let mut spread = || 8.0 + 2.6 * ((0..4).map(|_| rng.unit()).sum::<f64>() - 2.0);
            let x = DVec3::new(spread(), spread(), spread());
            let across = (3.0 * rng.unit()) as usize;
            let node: Vec<usize> = (0..3)
                .map(|a| {
                    let line = x[a] + if a == across { 0.0 } else { rng.unit() - rng.unit() };
                    let linear = line.floor() + f64::from(rng.unit() < line.fract());
                    (if a == across { line.round() } else { linear }) as usize
                })
                .collect();
            sum += f64::from(sharp[(node[2] * n + node[1]) * n + node[0]]) - at(x);
        }
        let mean = sum / f64::from(count);
        println!("off by {mean:.4}");
        assert!(mean.abs() < 0.015, "{mean}");
    }

    /// What is even stays so, beside nodes that show nothing too.
    #[test]
    fn even_light_is_not_sharpened() {
        let shown: Vec<bool> = (0..40).map(|i| i % 7 != 3).collect();
        let light: Vec<f32> = shown.iter().map(|shown| if *shown { 0.7 } else { 0.0 }).collect();
        let rows = |x: &[f32], row: usize| -> Cross {
            let read = |row: Option<usize>| row.filter(|r| *r < 4).map_or(Vec::new(), |r| x[10 * r..][..10].to_vec());
            [read(Some(row)), read(row.checked_sub(1)), read(Some(row + 1)), Vec::new(), Vec::new()]
        };
        let is: Vec<f32> = shown.iter().map(|shown| f32::from(*shown)).collect();
        for row in 0..4 {
            let mut sharp = rows(&light, row);
            sharpen(&mut sharp, &rows(&is, row), &mut Vec::new(), SHARPENING);
            for (sharp, _) in sharp[0].iter().zip(&shown[10 * row..]).filter(|x| *x.1) {
                assert_eq!(*sharp, 0.7);
            }
        }
    }

    /// Rows of random light, some of it not shown or negative, with and without memory, ω and an albedo of every node's
    /// own.
    #[test]
    fn every_instruction_set_reflects_the_same_bits() {
        let (nx, rows) = (61, 5);
        let mut rng = Rng::stream(3, Stage::Test, 0);
        let mut random = |n: usize| -> Vec<f32> { (0..n).map(|_| (rng.unit() * 1.3 - 0.3).max(0.0) as f32).collect() };
        let planes: Vec<[Vec<f32>; 3]> = vec![std::array::from_fn(|_| random(nx * rows))];
        let half = vec![HalfPlanes::new(&planes[0], 0.7, None)];
        // Of either sign.
        let short = vec![half[0].clone().short_of(&std::array::from_fn(|_| random(nx * rows)))];
        let shown: Cross = std::array::from_fn(|_| random(nx).iter().map(|x| f32::from(*x > 0.1)).collect());
        let albedo: Vec<[f32; 3]> = random(nx * rows).iter().map(|x| [*x, 0.5 * x, 0.3]).collect();
        let packed = |x: Vec<f32>| x.iter().map(|x| [half::encode(*x), half::encode(0.3 * x), 0, 0]).collect();
        let old = Reflected { b: vec![packed(random(nx * rows))], unit: 2.0 };
        let before: Vec<Half4> = packed(random(nx));
        let lit = LitRows::new(nx, &Blocks::along(nx, rows, (16, 0), |_| true));
        for (by_node, omega) in [(None, None), (None, Some([1.2, 1.1, 1.0])), (Some(&albedo[..]), Some([1.0; 3]))] {
            let job = RowJob {
                lit: &lit,
                light: &[
                    (NodeLight::Full(&planes), 1.0),
                    (NodeLight::Half(&half), 0.5),
                    (NodeLight::Signed(&short), 1.0),
                ],
                emission: [0.1, 0.0, 0.2],
                over_pi: [0.4, 0.6, 0.2],
                by_node,
                unit: 4.0,
                old: omega.map(|_| (&old, 2.0)),
                omega: omega.unwrap_or([1.0; 3]),
                memory: 0.5,
                sharpening: SHARPENING,
            };
            let run = |isa: Isa| {
                let mut b = before.clone();
                let mut rows = RowScratch { shown: shown.clone(), ..RowScratch::default() };
                let beside = [Some(2), Some(1), Some(3), Some(0), Some(4)];
                let sums = isa.reflect(&job, 0, beside, &mut rows, &mut b);
                (b, [sums.light, sums.change, sums.drift].map(|x| x.map(f64::to_bits)))
            };
            let plain = run(Isa::PLAIN);
            let lit = plain.0.iter().filter(|b| b[1] > 0).count();
            assert!(plain.0.iter().all(|b| b[3] == 0) && lit > nx / 4, "{lit}");
            for isa in Isa::found() {
                assert_eq!(plain, run(isa), "{isa:?}");
            }
        }
    }
}
