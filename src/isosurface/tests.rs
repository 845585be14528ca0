//! Meshes whose answers are known: closedness, Euler characteristic, areas and volumes, distance to the level set.

use super::*;
use std::collections::HashMap;
use std::f64::consts::PI;

/// Uniform numbers in [0, 1) from a counter.
fn hash(seed: u32, i: u32) -> f32 {
    let mut x = (i ^ seed.rotate_left(16)).wrapping_mul(0x9e37_79b9) ^ seed;
    for m in [0x85eb_ca6b, 0xc2b2_ae35u32] {
        x = (x ^ x >> 15).wrapping_mul(m);
    }
    ((x ^ x >> 16) >> 8) as f32 / 16_777_216.0
}

fn noise(n: usize, seed: u32) -> Vec<f32> {
    (0..n * n * n).map(|i| hash(seed, i as u32)).collect()
}

/// Samples of `h` at index coordinates.
fn sampled(dims: [usize; 3], h: impl Fn(DVec3) -> f64) -> Vec<f32> {
    let [nx, ny, nz] = dims;
    let mut samples = Vec::with_capacity(nx * ny * nz);
    for k in 0..nz {
        for j in 0..ny {
            samples.extend((0..nx).map(|i| h(DVec3::new(i as f64, j as f64, k as f64)) as f32));
        }
    }
    samples
}

/// What [`manifold`] counts.
#[derive(Debug, PartialEq)]
struct Topology {
    open: usize,
    euler: i64,
}

/// Panics unless every side of a triangle occurs once in its sense and at most once in the other, and every vertex is
/// used; returns the sides without a partner to `open`.
fn manifold(mesh: &Isosurface, mut open: impl FnMut(DVec3, DVec3)) -> Topology {
    let mut sides = HashMap::new();
    let mut used = vec![false; mesh.vertices.len()];
    for t in &mesh.triangles {
        assert!(t[0] != t[1] && t[1] != t[2] && t[2] != t[0], "{t:?}");
        for i in 0..3 {
            used[t[i] as usize] = true;
            assert!(sides.insert((t[i], t[(i + 1) % 3]), ()).is_none(), "a side twice in the same sense");
        }
    }
    assert!(used.iter().all(|u| *u), "a vertex that no triangle uses");
    assert!(mesh.vertices.iter().all(|v| v.is_finite()));
    let mut lonely = 0;
    for (a, b) in sides.keys() {
        if !sides.contains_key(&(*b, *a)) {
            lonely += 1;
            open(mesh.vertices[*a as usize], mesh.vertices[*b as usize]);
        }
    }
    let edges = (sides.len() + lonely) / 2;
    Topology { open: lonely, euler: mesh.vertices.len() as i64 - edges as i64 + mesh.triangles.len() as i64 }
}

/// Panics unless the mesh is manifold and open at most in the faces of a lattice.
fn open_on_the_boundary_only(mesh: &Isosurface, dims: [usize; 3]) -> Topology {
    let far = DVec3::from_array(dims.map(|n| (n - 1) as f64));
    manifold(mesh, |a, b| {
        let in_face = (0..3).any(|d| (a[d] == 0.0 && b[d] == 0.0) || (a[d] == far[d] && b[d] == far[d]));
        assert!(in_face, "open from {a} to {b}");
    })
}

fn areas(mesh: &Isosurface) -> impl Iterator<Item = ([DVec3; 3], DVec3)> + '_ {
    mesh.triangles.iter().map(|t| {
        let p = t.map(|v| mesh.vertices[v as usize]);
        (p, (p[1] - p[0]).cross(p[2] - p[0]) / 2.0)
    })
}

fn area(mesh: &Isosurface) -> f64 {
    areas(mesh).map(|(_, a)| a.length()).sum()
}

/// Enclosed volume; positive if the normals point out of it.
fn volume(mesh: &Isosurface) -> f64 {
    areas(mesh).map(|(p, a)| a.dot(p[0]) / 3.0).sum()
}

#[test]
fn noise_is_closed_and_manifold() {
    for seed in 0..4 {
        let mut samples = noise(24, seed);
        let mesh = extract([24; 3], &samples, 0.5).unwrap();
        assert!(open_on_the_boundary_only(&mesh, [24; 3]).open > 1000);
        assert_eq!(mesh.degenerate(), 0);
        // Below c all around: closed.
        for (o, h) in samples.iter_mut().enumerate() {
            if [o % 24, o / 24 % 24, o / 576].iter().any(|&i| i == 0 || i == 23) {
                *h = 0.0;
            }
        }
        let mesh = extract([24; 3], &samples, 0.5).unwrap();
        assert_eq!(open_on_the_boundary_only(&mesh, [24; 3]).open, 0);
        assert!(mesh.triangles.len() > 20_000);
        assert!(volume(&mesh) > 0.0);
    }
}

/// vtkMarchingCubes and vtkFlyingEdges3D of VTK 9.7 gave these counts for these fields.
#[test]
fn noise_has_the_counts_of_vtk() {
    for (seed, vertices, triangles) in [(0, 19835, 38717), (1, 19737, 38803), (2, 19891, 39086), (7, 19872, 39068)] {
        let mesh = extract([24; 3], &noise(24, seed), 0.5).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (vertices, triangles), "seed {seed}");
    }
}

/// The field `bumps` of the accuracy tables, on n³ samples of the unit cube.
fn bumps(n: usize) -> Vec<f32> {
    let g = |x: DVec3, m: [f64; 3], s: f64| (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp();
    sampled([n; 3], |p| {
        let x = p / (n - 1) as f64;
        100.0 * g(x, [0.50, 0.50, 0.38], 0.16)
            + 80.0 * (g(x, [0.32, 0.40, 0.74], 0.05) + g(x, [0.62, 0.35, 0.76], 0.05) + g(x, [0.52, 0.66, 0.72], 0.05))
    })
}

#[test]
fn bumps_have_the_counts_of_vtk() {
    let samples = bumps(101);
    let counts =
        [(3.6, 33717, 67300), (20.0, 19754, 39504), (35.0, 12904, 25792), (60.0, 6008, 12000), (95.0, 534, 1064)];
    for (c, vertices, triangles) in counts {
        let mesh = extract([101; 3], &samples, c).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (vertices, triangles), "c = {c}");
        // The lower level sets leave Ω.
        assert_eq!(open_on_the_boundary_only(&mesh, [101; 3]).open == 0, c > 4.0, "c = {c}");
    }
}

#[test]
fn integers_at_integer_isovalues_stay_closed() {
    // Few values, so that most samples of some cells equal c.
    for (seed, levels) in [(1, 256.0), (2, 4.0), (3, 2.0)] {
        let samples: Vec<f32> = noise(24, seed).iter().map(|h| (h * levels).floor()).collect();
        let c = levels / 2.0;
        let mesh = extract([24; 3], &samples, c).unwrap();
        open_on_the_boundary_only(&mesh, [24; 3]);
        assert!(levels == 256.0 || mesh.degenerate() > 1000);
        for v in &mesh.vertices {
            let f = v.fract();
            assert!((0..3).filter(|d| f[*d] != 0.0).count() <= 1, "{v} is not on an edge");
        }
        let refined = extract_refined([24; 3], &samples, c, 2).unwrap();
        open_on_the_boundary_only(&refined, [24; 3]);
    }
}

#[test]
fn the_extremes_are_what_inside_means() {
    let samples = vec![3.0f32; 27];
    // h ≥ c everywhere or nowhere: no boundary of the inside within Ω.
    for c in [3.0, 2.0, 4.0] {
        assert_eq!(extract([3; 3], &samples, c).unwrap(), Isosurface::default());
    }
    // One sample at c exactly among lower ones: a closed octahedron of no size.
    let mut samples = vec![0.0f32; 27];
    samples[13] = 5.0;
    let mesh = extract([3; 3], &samples, 5.0).unwrap();
    assert_eq!(manifold(&mesh, |_, _| ()), Topology { open: 0, euler: 2 });
    assert_eq!((mesh.vertices.len(), mesh.degenerate()), (6, 8));
    assert!(mesh.vertices.iter().all(|v| *v == DVec3::ONE));
    let mesh = extract([3; 3], &samples, 2.5).unwrap();
    assert!((volume(&mesh) - 8.0 * 0.125 / 6.0).abs() < 1e-15, "an octahedron with half axes ½");
}

#[test]
fn a_sphere_converges_to_the_closed_forms() {
    let mut errors = Vec::new();
    for n in [17usize, 33, 65] {
        let h = (n - 1) as f64;
        let samples = sampled([n; 3], |p| 1.0 - (p / h - 0.5).length_squared());
        let mut mesh = extract([n; 3], &samples, 1.0 - 0.09).unwrap();
        assert_eq!(manifold(&mesh, |_, _| ()), Topology { open: 0, euler: 2 });
        let (a, v) = (area(&mesh) / (h * h) / (4.0 * PI * 0.09), volume(&mesh) / h.powi(3) / (4.0 / 3.0 * PI * 0.027));
        assert!(a < 1.0 && v < 1.0, "triangles below a convex surface");
        errors.push((1.0 - a, 1.0 - v));
        // The normals point to the lower side: out. In a left-handed world the order must turn for that.
        let extracted = mesh.clone();
        mesh.face_outside(DMat3::from_diagonal(DVec3::new(1.0, 1.0, 3.0)), false);
        assert_eq!(mesh, extracted);
        mesh.face_outside(DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0)), false);
        assert!((volume(&mesh) + volume(&extracted)).abs() < 1e-9 * volume(&extracted));
        mesh.face_outside(DMat3::IDENTITY, true);
        assert_eq!(mesh, extracted);
    }
    assert!(errors[0].0 < 0.02 && errors[0].1 < 0.04, "{errors:?}");
    for pair in errors.windows(2) {
        assert!((3.4..4.6).contains(&(pair[0].0 / pair[1].0)), "area: {errors:?}");
        assert!((3.4..4.6).contains(&(pair[0].1 / pair[1].1)), "volume: {errors:?}");
    }
}

#[test]
fn a_plane_is_open_at_the_faces_and_exact() {
    let dims = [70, 5, 4]; // more than one word in a row
    let samples = sampled(dims, |p| p.x + 2.0 * p.y + 3.0 * p.z);
    let mesh = extract(dims, &samples, 20.25).unwrap();
    assert_eq!(open_on_the_boundary_only(&mesh, dims).euler, 1);
    for v in &mesh.vertices {
        assert!((v.x + 2.0 * v.y + 3.0 * v.z - 20.25).abs() < 1e-12);
    }
    let (projected, normals) = areas(&mesh).fold((0.0, 0), |(p, n), (_, a)| {
        let down = a.dot(DVec3::new(-1.0, -2.0, -3.0));
        (p + a.x, n + usize::from(down > 0.0))
    });
    assert_eq!(normals, mesh.triangles.len());
    // For every (y, z) in Ω x = 20.25 − 2y − 3z lies in Ω: the plane's shadow along x is the whole face.
    assert!((projected + 12.0).abs() < 1e-12, "{projected}");
}

/// The trilinear value and gradient at index coordinates.
fn trilinear(samples: &[f32], dims: [usize; 3], p: DVec3) -> (f64, DVec3) {
    let cell: [usize; 3] = [0, 1, 2].map(|d| (p[d] as usize).min(dims[d] - 2));
    let (mut value, mut gradient) = (0.0, DVec3::ZERO);
    for corner in 0..8 {
        let bit = [0, 1, 2].map(|d| corner >> d & 1);
        let at = [0, 1, 2].map(|d| cell[d] + bit[d]);
        let h = f64::from(samples[(at[2] * dims[1] + at[1]) * dims[0] + at[0]]);
        let t = [0, 1, 2].map(|d| p[d] - cell[d] as f64);
        let w = [0, 1, 2].map(|d| if bit[d] == 1 { t[d] } else { 1.0 - t[d] });
        let s = bit.map(|b| if b == 1 { 1.0 } else { -1.0 });
        value += h * w[0] * w[1] * w[2];
        gradient += h * DVec3::new(s[0] * w[1] * w[2], w[0] * s[1] * w[2], w[0] * w[1] * s[2]);
    }
    (value, gradient)
}

#[test]
fn refinement_converges_to_the_trilinear_level_set() {
    let n = 9;
    let samples: Vec<f32> = sampled([n; 3], |p| {
        let x = p * 0.7;
        (x.x.sin() * x.y.cos() + x.y.sin() * x.z.cos() + x.z.sin() * x.x.cos()) * 3.0
    });
    let mut distances = Vec::new();
    for factor in [1, 2, 4, 8] {
        let mesh = extract_refined([n; 3], &samples, 0.4, factor).unwrap();
        open_on_the_boundary_only(&mesh, [n; 3]);
        // Vertices lie on the trilinear level set itself, at every refinement.
        for v in &mesh.vertices {
            assert!((trilinear(&samples, [n; 3], *v).0 - 0.4).abs() < 1e-6, "{v}");
        }
        let (sum, weight) = areas(&mesh).fold((0.0, 0.0), |(sum, weight), (p, a)| {
            let (h, g) = trilinear(&samples, [n; 3], (p[0] + p[1] + p[2]) / 3.0);
            (sum + a.length() * ((h - 0.4) / g.length()).powi(2), weight + a.length())
        });
        distances.push(f64::sqrt(sum / weight));
    }
    for pair in distances.windows(2) {
        assert!((3.3..4.7).contains(&(pair[0] / pair[1])), "{distances:?}");
    }
    assert_eq!(extract_refined([n; 3], &samples, 0.4, 1).unwrap(), extract([n; 3], &samples, 0.4).unwrap());
}

#[test]
fn refined_noise_is_watertight() {
    let samples = noise(12, 5);
    for factor in [2, 3] {
        let mesh = extract_refined([12; 3], &samples, 0.5, factor).unwrap();
        open_on_the_boundary_only(&mesh, [12; 3]);
    }
}

#[test]
fn cells_with_a_non_finite_corner_hold_no_surface() {
    let n = 20;
    let full = noise(n, 9);
    let complete = extract([n; 3], &full, 0.5).unwrap();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut samples = full.clone();
        let holes: Vec<usize> = (0..60).map(|i| (hash(99, i) * samples.len() as f32) as usize).collect();
        holes.iter().for_each(|&o| samples[o] = bad);
        let touches = |p: DVec3| {
            let low = p.floor().as_usizevec3().min(glam::USizeVec3::splat(n - 2));
            (0..8).any(|c| {
                let corner = low + glam::USizeVec3::new(c & 1, c >> 1 & 1, c >> 2);
                !samples[(corner.z * n + corner.y) * n + corner.x].is_finite()
            })
        };
        let mesh = extract([n; 3], &samples, 0.5).unwrap();
        manifold(&mesh, |_, _| ());
        // Exactly the triangles of the usable cells are left, in the same order. A centroid is inside its cell.
        let centroids = |mesh: &Isosurface| areas(mesh).map(|(p, _)| (p[0] + p[1] + p[2]) / 3.0).collect::<Vec<_>>();
        let expected: Vec<DVec3> = centroids(&complete).into_iter().filter(|p| !touches(*p)).collect();
        assert_eq!(centroids(&mesh), expected);
        assert!(expected.len() < complete.triangles.len() - 1000);
        let refined = extract_refined([n; 3], &samples, 0.5, 2).unwrap();
        manifold(&refined, |_, _| ());
        assert!(centroids(&refined).iter().all(|p| !touches(*p)));
    }
    let nothing = extract([4; 3], &[f32::NAN; 64], 0.5).unwrap();
    assert_eq!(nothing, Isosurface::default());
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let samples = noise(30, 3);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| extract([30; 3], &samples, 0.37).unwrap())
    };
    let one = with(1);
    assert_eq!(one, with(2));
    assert_eq!(one, with(7));
}

#[test]
fn rows_of_whole_words_and_thin_lattices() {
    for dims in [[64, 3, 2], [65, 2, 3], [128, 2, 2], [129, 4, 4], [2, 2, 2], [63, 2, 2], [2, 70, 2]] {
        let samples: Vec<f32> = (0..dims.iter().product::<usize>()).map(|i| hash(11, i as u32)).collect();
        let mesh = extract(dims, &samples, 0.5).unwrap();
        open_on_the_boundary_only(&mesh, dims);
        // Every crossed edge has its vertex.
        let inside = |i: usize, j: usize, k: usize| samples[(k * dims[1] + j) * dims[0] + i] >= 0.5;
        let mut crossed = 0;
        for (i, j, k) in (0..samples.len()).map(|o| (o % dims[0], o / dims[0] % dims[1], o / (dims[0] * dims[1]))) {
            let here = inside(i, j, k);
            crossed += usize::from(i + 1 < dims[0] && here != inside(i + 1, j, k));
            crossed += usize::from(j + 1 < dims[1] && here != inside(i, j + 1, k));
            crossed += usize::from(k + 1 < dims[2] && here != inside(i, j, k + 1));
        }
        assert_eq!(mesh.vertices.len(), crossed, "{dims:?}");
    }
}

#[test]
fn wrong_arguments_are_named() {
    let message = |r: Result<Isosurface>| r.unwrap_err().to_string();
    assert!(message(extract([1, 2, 2], &[0.0; 4], 0.5)).contains("1×2×2"));
    assert!(message(extract([2; 3], &[0.0; 7], 0.5)).contains("7 samples were given"));
    assert!(message(extract([2; 3], &[0.0; 8], f32::NAN)).contains("NaN"));
    assert!(message(extract_refined([2; 3], &[0.0; 8], 0.5, 0)).contains("factor 0"));
    assert!(message(extract_refined([2; 3], &[0.0; 8], 0.5, 1 << 40)).contains("too large"));
}
