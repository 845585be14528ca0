//! Isosurfaces: the level set {h = c} as an indexed triangle mesh, by marching cubes in index space.
//!
//! * Inside is h ≥ c. Vertices stand on the edges of the lattice (of the refined lattice, for [`extract_refined`]),
//!   where trilinear is linear: they lie on the trilinear level set up to rounding. Triangles approximate it in
//!   between.
//! * One vertex per crossed edge, named by its edge, not by its place. So the mesh is closed and manifold **by index**
//!   for every input: each side of a triangle belongs to exactly two triangles, in opposite senses, except on the
//!   boundary of Ω and of the non-finite region, where it belongs to one. When c equals lattice values, several
//!   vertices of one sample coincide and some triangles have no area. They are kept: dropping them would open the mesh,
//!   and merging their vertices can join more than two triangles in an edge. [`Isosurface::degenerate`] counts them.
//! * Faces with two inside corners on a diagonal are resolved by separating the inside, as VTK's marching cubes do. The
//!   trilinear level set itself may join them: refinement, not a case table, follows it there.
//! * A cell that touches a NaN or an infinite sample holds no surface.

mod source;
mod table;
#[cfg(test)]
mod tests;

use crate::error::{Error, Result};
use crate::progress::{interrupted, unless_interrupted};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use source::{Plain, Refined, Source};
use table::CASES;

/// A triangle mesh in index coordinates: sample (i, j, k) stands at (i, j, k).
///
/// Triangles from [`extract`] turn counter-clockwise seen from the lower side: their right-hand normals point to where
/// h < c, in index space. In a world with left-handed axes, or where outside is higher, they must be flipped:
/// [`Isosurface::face_outside`] does what is needed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Isosurface {
    /// Vertices, in index coordinates.
    pub vertices: Vec<DVec3>,
    /// Triangles, as indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

impl Isosurface {
    /// Turns every triangle around.
    pub fn flip(&mut self) {
        self.triangles.par_iter_mut().for_each(|t| t.swap(1, 2));
    }

    /// Turns a mesh as extracted so that its triangles' right-hand normals point outside **in the world**: flips it if
    /// exactly one of "`axes` (world steps per index, one column per axis) are left-handed" and "outside is the higher
    /// side" holds. To be called once per extraction.
    pub fn face_outside(&mut self, axes: DMat3, outside_is_higher: bool) {
        if (axes.determinant() < 0.0) != outside_is_higher {
            self.flip();
        }
    }

    /// Number of triangles whose corners do not span an area: two coincide, or they are exactly collinear.
    pub fn degenerate(&self) -> usize {
        let corner = |v: u32| self.vertices[v as usize];
        let flat = |t: &&[u32; 3]| (corner(t[1]) - corner(t[0])).cross(corner(t[2]) - corner(t[0])) == DVec3::ZERO;
        self.triangles.par_iter().filter(flat).count()
    }
}

/// The isosurface {h = `isovalue`} of `samples` (x fastest) on a lattice of `dims` samples.
///
/// The result does not depend on the number of threads. It holds no vertex that no triangle uses. An isovalue outside
/// the samples' range gives an empty mesh.
///
/// # Errors
/// `Invalid` if a dimension is below 2, `samples` does not hold their product or the isovalue is not finite;
/// `NotSupported` if the mesh has more vertices than u32 can name; `Interrupted`.
pub fn extract(dims: [usize; 3], samples: &[f32], isovalue: f32) -> Result<Isosurface> {
    check(dims, samples, isovalue)?;
    march(&Plain { dims, samples }, f64::from(isovalue))
}

/// As [`extract`], with every cell cut into `factor`³ subcells by trilinear interpolation, in f64.
///
/// Values on faces between cells are shared bit for bit, so the mesh is as closed as the unrefined one. The distance of
/// the triangles to the trilinear level set falls with 1/factor² where that is smooth within cells. Cost: time and
/// 1 bit per refined sample grow with factor³, triangles with factor².
///
/// # Errors
/// As [`extract`]; `Invalid` if `factor` is 0, `NotSupported` if the refined lattice does not fit the address space.
pub fn extract_refined(dims: [usize; 3], samples: &[f32], isovalue: f32, factor: usize) -> Result<Isosurface> {
    check(dims, samples, isovalue)?;
    match factor {
        0 => return Err(Error::Invalid("refinement factor 0: it must be at least 1".into())),
        1 => return extract(dims, samples, isovalue),
        _ => {}
    }
    let fits = |n: usize, d: &usize| (d - 1).checked_mul(factor)?.checked_add(1)?.checked_mul(n);
    if dims.iter().try_fold(1, fits).is_none_or(|n: usize| n > isize::MAX as usize / 16) {
        return Err(Error::NotSupported(format!(
            "refinement factor {factor} of {}×{}×{} samples: too large for this machine's address space",
            dims[0], dims[1], dims[2]
        )));
    }
    march(&Refined { coarse: Plain { dims, samples }, factor }, f64::from(isovalue))
}

/// The conditions on the arguments of [`extract`].
fn check(dims: [usize; 3], samples: &[f32], isovalue: f32) -> Result<()> {
    let [nx, ny, nz] = dims;
    if dims.iter().any(|&n| n < 2) {
        return Err(Error::Invalid(format!(
            "isosurface of {nx}×{ny}×{nz} samples: every dimension must be at least 2 to hold a cell"
        )));
    }
    if dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d)) != Some(samples.len()) {
        return Err(Error::Invalid(format!(
            "isosurface of {nx}×{ny}×{nz} samples: {} samples were given",
            samples.len()
        )));
    }
    if !isovalue.is_finite() {
        return Err(Error::Invalid(format!("isovalue {isovalue}: it must be finite")));
    }
    Ok(())
}

/// Planes of samples that one task fills. The result does not depend on it.
const SLAB: usize = 4;

/// One bit per sample, in rows of whole words: which side it is on and, if any is not finite, which cells are usable.
struct Bits {
    dims: [usize; 3],
    /// Words per row.
    words: usize,
    inside: Vec<u64>,
    /// Bit i of row (j, k): all corners of cell (i, j, k) are finite. `None` if all samples are finite.
    usable: Option<Vec<u64>>,
}

/// Bit i + 1 of a row at bit i of the word `w`; zero beyond the row.
#[inline]
fn shifted_down(row: &[u64], w: usize) -> u64 {
    row[w] >> 1 | row.get(w + 1).map_or(0, |next| next << 63)
}

/// Bit i − 1 of a row at bit i of the word `w`; zero before the row.
#[inline]
fn shifted_up(word: impl Fn(usize) -> u64, w: usize) -> u64 {
    word(w) << 1 | if w > 0 { word(w - 1) >> 63 } else { 0 }
}

/// `words` words of zeros for each row.
fn words_for([nx, ny, nz]: [usize; 3], words: usize) -> Result<Vec<u64>> {
    let mut all = Vec::new();
    if all.try_reserve_exact(words * ny * nz).is_err() {
        return Err(Error::NotSupported(format!(
            "isosurface of {nx}×{ny}×{nz} samples, refined ones included: there is not enough memory for a bit of each"
        )));
    }
    all.resize(words * ny * nz, 0);
    Ok(all)
}

impl Bits {
    fn new(source: &impl Source, c: f64) -> Result<Self> {
        let dims @ [nx, ny, _] = source.dims();
        let words = nx.div_ceil(64);
        let mut inside = words_for(dims, words)?;
        let finite = inside
            .par_chunks_mut(words * ny)
            .enumerate()
            .map_init(
                || vec![0.0; nx],
                |row, (k, plane)| {
                    if interrupted() {
                        return true;
                    }
                    let rows = plane.chunks_mut(words).enumerate();
                    rows.fold(true, |finite, (j, bits)| source.classify(j, k, c, row, bits) & finite)
                },
            )
            .reduce(|| true, |a, b| a & b);
        unless_interrupted()?;
        let usable = (!finite).then(|| usable_cells(source, words)).transpose()?;
        Ok(Self { dims, words, inside, usable })
    }

    #[inline]
    fn row(&self, j: usize, k: usize) -> &[u64] {
        let start = (k * self.dims[1] + j) * self.words;
        &self.inside[start..start + self.words]
    }

    /// Word `w` of the usable cells of row (j, k); none outside the lattice.
    #[inline]
    fn usable(&self, j: usize, k: usize, w: usize) -> u64 {
        let [_, ny, nz] = self.dims;
        match &self.usable {
            Some(usable) if j < ny - 1 && k < nz - 1 => usable[(k * ny + j) * self.words + w],
            Some(_) => 0,
            None => !0,
        }
    }

    /// The crossed edges that leave samples of word `w` of row (j, k) along x, y and z, without those that have no
    /// usable cell next to them.
    #[inline]
    fn crossed(&self, j: usize, k: usize, w: usize) -> [u64; 3] {
        let [nx, ny, nz] = self.dims;
        let row = self.row(j, k);
        let here = row[w];
        // The last sample of a row has no edge along x.
        let last = if w == (nx - 1) / 64 { !(!0 << ((nx - 1) % 64)) } else { !0 };
        let mut x = (here ^ shifted_down(row, w)) & last;
        let mut y = if j + 1 < ny { here ^ self.row(j + 1, k)[w] } else { 0 };
        let mut z = if k + 1 < nz { here ^ self.row(j, k + 1)[w] } else { 0 };
        if self.usable.is_some() {
            let before = |n: usize| n.wrapping_sub(1); // usize::MAX is outside the lattice
            let either = |a: (usize, usize), b: (usize, usize)| {
                let cells = |w| self.usable(a.0, a.1, w) | self.usable(b.0, b.1, w);
                (cells(w), cells(w) | shifted_up(cells, w))
            };
            let low = either((before(j), before(k)), (j, before(k)));
            let high = either((before(j), k), (j, k));
            x &= low.0 | high.0;
            y &= either((j, before(k)), (j, k)).1;
            z &= either((before(j), k), (j, k)).1;
        }
        [x, y, z]
    }

    /// Calls `visit(i, corner bits)` for the cells of row (j, k) that have a crossed edge, in the order of i; the bits
    /// are zero where the cell is not usable.
    #[inline]
    fn each_cell(&self, j: usize, k: usize, mut visit: impl FnMut(usize, u8)) {
        let rows = [self.row(j, k), self.row(j + 1, k), self.row(j, k + 1), self.row(j + 1, k + 1)];
        let cells = self.dims[0] - 1;
        for w in 0..cells.div_ceil(64) {
            let near = rows.map(|row| row[w]);
            let far = rows.map(|row| shifted_down(row, w));
            let any = near.iter().chain(&far).fold(0, |a, b| a | b);
            let all = near.iter().chain(&far).fold(!0, |a, b| a & b);
            let mut active = any & !all;
            if w == cells / 64 {
                active &= !(!0 << (cells % 64));
            }
            let usable = self.usable(j, k, w);
            while active != 0 {
                let bit = active.trailing_zeros();
                active &= active - 1;
                let corner = |row: usize| near[row] >> bit & 1 | (far[row] >> bit & 1) << 1;
                let bits = corner(0) | corner(1) << 2 | corner(2) << 4 | corner(3) << 6;
                visit(w * 64 + bit as usize, if usable >> bit & 1 == 1 { bits as u8 } else { 0 });
            }
        }
    }
}

/// The cells all of whose corners are finite, as in [`Bits::usable`].
fn usable_cells(source: &impl Source, words: usize) -> Result<Vec<u64>> {
    let dims @ [nx, ny, nz] = source.dims();
    let mut finite = words_for(dims, words)?;
    finite.par_chunks_mut(words * ny).enumerate().for_each_init(
        || vec![0.0; nx],
        |row, (k, plane)| {
            for (j, bits) in plane.chunks_mut(words).enumerate() {
                source.row(j, k, row);
                row.iter().enumerate().for_each(|(i, h)| bits[i / 64] |= u64::from(h.is_finite()) << (i % 64));
            }
        },
    );
    let row = |j: usize, k: usize| &finite[(k * ny + j) * words..][..words];
    let mut usable = words_for(dims, words)?;
    usable.par_chunks_mut(words * ny).take(nz - 1).enumerate().for_each(|(k, plane)| {
        for (j, cells) in plane.chunks_mut(words).take(ny - 1).enumerate() {
            let rows = [row(j, k), row(j + 1, k), row(j, k + 1), row(j + 1, k + 1)];
            for (w, cells) in cells.iter_mut().enumerate() {
                *cells = rows.iter().fold(!0, |all, row| all & row[w] & shifted_down(row, w));
            }
        }
    });
    Ok(usable)
}

/// Where the vertices and triangles of each row begin. A row (j, k) owns the edges that leave its samples, those along
/// x first, then y, then z, and the triangles of the cells above it.
struct Starts {
    /// First vertex along x, y and z of each row, then a last entry with the total.
    vertices: Vec<[u32; 3]>,
    /// First triangle of each row, then the total.
    triangles: Vec<usize>,
}

impl Starts {
    fn new(bits: &Bits) -> Result<Self> {
        let [_, ny, nz] = bits.dims;
        let counts: Vec<([u32; 3], u32)> = (0..ny * nz)
            .into_par_iter()
            .with_min_len(64)
            .map(|r| {
                let (j, k) = (r % ny, r / ny);
                let mut vertices = [0; 3];
                for w in 0..bits.words {
                    bits.crossed(j, k, w).iter().zip(&mut vertices).for_each(|(b, n)| *n += b.count_ones());
                }
                let mut triangles = 0;
                if j + 1 < ny && k + 1 < nz {
                    bits.each_cell(j, k, |_, case| triangles += CASES[case as usize].triangles().len() as u32);
                }
                (vertices, triangles)
            })
            .collect();
        let (mut vertices, mut triangles) =
            (Vec::with_capacity(counts.len() + 1), Vec::with_capacity(counts.len() + 1));
        let (mut vertex, mut triangle) = (0u64, 0usize);
        for (v, t) in &counts {
            // Wrapped numbers are never used: the total is checked below.
            vertices.push([vertex, vertex + u64::from(v[0]), vertex + u64::from(v[0] + v[1])].map(|n| n as u32));
            triangles.push(triangle);
            vertex += v.iter().map(|n| u64::from(*n)).sum::<u64>();
            triangle += *t as usize;
        }
        let total = u32::try_from(vertex).map_err(|_| {
            Error::NotSupported(format!("isosurface of {vertex} vertices: a mesh can hold at most {}", u32::MAX))
        })?;
        vertices.push([total; 3]);
        triangles.push(triangle);
        Ok(Self { vertices, triangles })
    }
}

/// Marching cubes of any source.
fn march(source: &impl Source, c: f64) -> Result<Isosurface> {
    let bits = Bits::new(source, c)?;
    let starts = Starts::new(&bits)?;
    let [_, ny, nz] = bits.dims;

    let last = ny * nz;
    let mut vertices = vec![DVec3::ZERO; starts.vertices[last][0] as usize];
    let mut triangles = vec![[0u32; 3]; starts.triangles[last]];
    let mut slabs = Vec::new();
    let (mut free_vertices, mut free_triangles) = (vertices.as_mut_slice(), triangles.as_mut_slice());
    for first in (0..nz).step_by(SLAB) {
        let end = (first + SLAB).min(nz);
        let (own_vertices, own_triangles);
        let count = starts.vertices[end * ny][0] - starts.vertices[first * ny][0];
        (own_vertices, free_vertices) = free_vertices.split_at_mut(count as usize);
        let count = starts.triangles[end * ny] - starts.triangles[first * ny];
        (own_triangles, free_triangles) = free_triangles.split_at_mut(count);
        slabs.push((first..end, own_vertices, own_triangles));
    }
    slabs.into_par_iter().for_each(|(planes, vertices, triangles)| {
        let (mut vertices, mut triangles) = (vertices.iter_mut(), triangles.iter_mut());
        for k in planes.take_while(|_| !interrupted()) {
            for j in 0..ny {
                place_vertices(source, &bits, c, j, k, &mut vertices);
                if j + 1 < ny && k + 1 < nz {
                    join_vertices(&bits, &starts, j, k, &mut triangles);
                }
            }
        }
    });
    unless_interrupted()?;
    Ok(Isosurface { vertices, triangles })
}

/// Writes the vertices that row (j, k) owns.
fn place_vertices<'a>(
    source: &impl Source,
    bits: &Bits,
    c: f64,
    j: usize,
    k: usize,
    out: &mut impl Iterator<Item = &'a mut DVec3>,
) {
    for axis in 0..3 {
        for w in 0..bits.words {
            let mut crossed = bits.crossed(j, k, w)[axis];
            while crossed != 0 {
                let i = w * 64 + crossed.trailing_zeros() as usize;
                crossed &= crossed - 1;
                let mut end = [i, j, k];
                end[axis] += 1;
                let (a, b) = (source.at(i, j, k), source.at(end[0], end[1], end[2]));
                // a ≠ b, since c separates them. Exact at both ends; never beyond them, since rounding is monotone.
                let t = (c - a) / (b - a);
                let mut p = [i as f64, j as f64, k as f64];
                p[axis] += t;
                *out.next().expect("as many places as crossed edges") =
                    DVec3::from_array(p.map(|x| source.index_coordinate(x)));
            }
        }
    }
}

/// Writes the triangles of the cells of row (j, k).
fn join_vertices<'a>(
    bits: &Bits,
    starts: &Starts,
    j: usize,
    k: usize,
    out: &mut impl Iterator<Item = &'a mut [u32; 3]>,
) {
    let ny = bits.dims[1];
    let row = |y: usize, z: usize| (k + z) * ny + j + y;
    // The vertices on the cell's edges, in the order of EDGES. Edges at x = 0 count the crossed ones passed so far;
    // every crossed edge belongs to a visited cell, so stepping over the other cells misses none.
    let along = |axis: usize, y, z| starts.vertices[row(y, z)][axis];
    let mut next_x = [along(0, 0, 0), along(0, 1, 0), along(0, 0, 1), along(0, 1, 1)];
    let mut next_y = [along(1, 0, 0), along(1, 0, 1)];
    let mut next_z = [along(2, 0, 0), along(2, 1, 0)];
    let cases = &**CASES;
    // The crossed edges along x, y and z that leave the samples of the current word of the four rows.
    let (mut word, mut crossed) = (usize::MAX, [[0u64; 3]; 4]);
    bits.each_cell(j, k, |i, case| {
        if word != i / 64 {
            word = i / 64;
            crossed = [(j, k), (j + 1, k), (j, k + 1), (j + 1, k + 1)].map(|(j, k)| bits.crossed(j, k, word));
        }
        let is = |row: usize, axis: usize| (crossed[row][axis] >> (i % 64) & 1) as u32;
        let (y, z) = ([is(0, 1), is(2, 1)], [is(0, 2), is(1, 2)]);
        let on_edge = [
            next_x[0],
            next_x[1],
            next_x[2],
            next_x[3],
            next_y[0],
            next_y[0] + y[0],
            next_y[1],
            next_y[1] + y[1],
            next_z[0],
            next_z[0] + z[0],
            next_z[1],
            next_z[1] + z[1],
        ];
        for t in cases[case as usize].triangles() {
            *out.next().expect("as many places as triangles") = t.map(|e| on_edge[e as usize]);
        }
        next_x.iter_mut().enumerate().for_each(|(row, next)| *next += is(row, 0));
        next_y.iter_mut().zip(y).for_each(|(next, crossed)| *next += crossed);
        next_z.iter_mut().zip(z).for_each(|(next, crossed)| *next += crossed);
    });
}
