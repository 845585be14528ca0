//! The table of data sets: error and seconds with and without final gather, and where the error comes from.

use super::{Effort, Study, Subject, Table, accuracy_of, exactly, provenance};
use crate::accuracy::{InterpolationFloor, ReferenceMesh, display, percent};
use crate::bake::{Bake, BakeOptions, BakeSettings, Engine, StrategyName};
use crate::embree::{GraphTracer, SurfaceTracer};
use crate::error::Result;
use crate::illumination_grid::GridSize;
use crate::mask::Mask;
use crate::progress::Progress;
use crate::reference::{Reference, ReferenceSettings, path_picture, reference};
use crate::render::Camera;
use crate::scene::Scene;
use crate::surface_mesh::SurfaceMesh;
use glam::DVec3;
use std::time::Instant;

const COLUMNS: [&str; 27] = [
    "scene",
    "mode",
    "isovalue",
    "grid",
    "photons",
    "samples",
    "percent_rms",
    "ci_lo",
    "ci_hi",
    "percent_rms_area",
    "percent_rms_lit",
    "noise",
    "floor_1x",
    "floor_2x",
    "floor_3x",
    "floor_total",
    "triangles_vs_trilinear",
    "build_s",
    "photons_s",
    "cache_s",
    "sweep_or_samples_s",
    "total_s",
    "cpu_s",
    "extract_s",
    "picture_s",
    "job",
    "program",
];

/// Each data set at its main isovalue: straight from the map, with uniform samples as BB09 and with samples at the
/// nodes; samples at the nodes with final gather, and the sweep engine (or those of the engine that `base` names); the
/// interpolation floor of direct light at grid factors 1, 2, 3, and of all light on the bakes' grid; the reference on
/// triangles against the one on the trilinear surface.
///
/// # Errors
/// As bakes, references and tables.
pub fn datasets(study: &Study, subjects: &[Subject], base: &BakeOptions) -> Result<()> {
    let mut table = Table::open(study.folder.join("datasets.csv"), &COLUMNS, 3)?;
    let exact = |strategy, gather_rays| BakeOptions {
        engine: Some(Engine::Photon),
        strategy: Some(strategy),
        gather_rays,
        ..BakeOptions::default()
    };
    let modes: [(&str, BakeOptions); 4] = [
        ("map, uniform", exact(StrategyName::Uniform, Some(0))),
        ("map", exact(StrategyName::Nodes, Some(0))),
        ("nodes", exact(StrategyName::Nodes, None)),
        ("sweep", BakeOptions { engine: Some(Engine::Sweep), ..BakeOptions::default() }),
    ];
    let modes =
        modes.into_iter().filter(|(_, options)| base.engine.is_none_or(|engine| options.engine == Some(engine)));
    let modes: Vec<(&str, BakeOptions)> = modes.collect();
    let jobs = study.jobs(&table, subjects, base, &["strategy"])?;
    subjects.iter().try_for_each(|s| s.with_surfaces(&[s.main_isovalue()]).map(drop))?;
    for (subject, job) in subjects.iter().zip(&jobs) {
        let scene = &subject.scene;
        let c = subject.main_isovalue();
        let key = |mode: &str| vec![subject.name.clone(), mode.to_owned(), exactly(c)];
        if modes.iter().all(|(mode, _)| table.has(&key(mode))) {
            continue;
        }
        study.say(&format!("{}: isovalue {c}", subject.name));
        let unit = scene.field.sweep().isovalue(c);
        let begun = Instant::now();
        let mesh = SurfaceMesh::extract(scene, unit, 1)?;
        let extract_seconds = begun.elapsed().as_secs_f64();
        let picture_seconds = reference_picture(study, scene, unit)?;
        let references = study.references(subject, c, Effort::Table)?;
        let tracer = GraphTracer::new(&study.device, scene)?;
        // At the vertices of the references: few of them carry much of an error, and of its floor.
        let vertices = references[0].sampled.iter().filter(|s| **s).count();
        let shadow = if study.quick { 64 } else { 1024 };
        let floor = |grid| InterpolationFloor { scene, tracer: &tracer, mesh: &mesh, grid };
        let mut floors = Vec::new();
        for grid in [1, 2, 3].map(|n| GridSize::Factors([n; 3])) {
            floors.push(floor(grid).direct(unit, shadow, Some(vertices))?);
        }
        let paths = if study.quick { 64 } else { 256 };
        let grid = base.grid.unwrap_or(GridSize::OWN);
        let total = floor(grid).total(&references, paths, vertices)?;
        let triangles = triangle_error(study, subject, &mesh, unit)?;
        for (mode, options) in &modes {
            if table.has(&key(mode)) {
                continue;
            }
            let settings = BakeSettings::new(&options.clone().or(base), scene)?;
            let (bake, seconds) = study.bake(subject, &settings)?;
            let a = accuracy_of(scene, &bake, &references)?;
            let mut row = key(mode);
            row.extend(counts(&bake));
            let s = bake.report.seconds;
            let errors = [a.percent_rms, a.confidence[0], a.confidence[1], a.percent_rms_area, a.percent_rms_lit];
            let floors = [noise(&bake, &references[0]), floors[0], floors[1], floors[2], total, triangles];
            let stages = [s.build, s.photons, s.cache, s.sweep + s.samples + s.interpolate];
            let times = [seconds[0], seconds[1], extract_seconds, picture_seconds];
            let numbers = errors.into_iter().chain(floors).chain(stages).chain(times);
            row.extend(numbers.map(|x| format!("{x:.4}")));
            row.extend(job.clone());
            table.push(row)?;
        }
    }
    let notes = format!(
        "BB09: nucleon 5.61 % in 9685 s, fluid 8.06 % in 5565 s, brain 6.53 % in 5452 s, neuron 5.70 % in 4587 s; \
         0.885 s to extract and texture.\n\n{}",
        provenance(study)
    );
    table.write_markdown(&study.folder.join("datasets.md"), "Data sets", &notes)
}

/// The grid's points, photons and samples of a bake.
fn counts(bake: &Bake) -> [String; 3] {
    let [nx, ny, nz] = bake.lattice.dims();
    // Sweeps need none.
    let emitted = match bake.report.photons.emitted {
        0 => "-".to_owned(),
        emitted => emitted.to_string(),
    };
    [format!("{nx}x{ny}x{nz}"), emitted, bake.report.samples.to_string()]
}

/// Wall seconds of a path-traced reference picture of 400 × 400 pixels with 64 paths each.
fn reference_picture(study: &Study, scene: &Scene, isovalue: f32) -> Result<f64> {
    let begun = Instant::now();
    let tracer = SurfaceTracer::new(&study.device, scene, isovalue, 1)?;
    let samples = if study.quick { 4 } else { 64 };
    let camera = Camera { size: [400; 2], samples, ..Camera::facing(scene, 400) };
    path_picture(scene, &tracer, isovalue, &camera, Progress::Quiet)?;
    Ok(begun.elapsed().as_secs_f64())
}

/// The bake's own noise at the reference's vertices, percent RMS over three channels: what `std_error` says,
/// interpolated as if neighbouring points erred alike, so at most this.
fn noise(bake: &Bake, reference: &ReferenceMesh) -> f64 {
    let grid = &bake.sides[0].1;
    let variance = |x: DVec3| {
        let around =
            bake.lattice.around(bake.lattice.to_index(x)).into_iter().filter(|(o, _)| grid.mask[*o] != Mask::Empty);
        let (sum, weights) = around
            .fold((0.0, 0.0), |(sum, weights), (o, w)| (sum + w * f64::from(grid.std_error[o]).powi(2), weights + w));
        if weights > 0.0 { sum / weights } else { 0.0 }
    };
    let (mut sum, mut count) = (0.0, 0.0);
    for (&x, _) in reference.positions.iter().zip(&reference.sampled).filter(|(_, s)| **s) {
        sum += variance(x);
        count += 1.0;
    }
    100.0 * bake.exposure * (3.0 * sum / f64::max(count, 1.0)).sqrt()
}

/// Percent RMS between references traced through triangles and through the trilinear surface, without their noise.
fn triangle_error(study: &Study, subject: &Subject, mesh: &SurfaceMesh, isovalue: f32) -> Result<f64> {
    let scene = &subject.scene;
    let settings = |seed| ReferenceSettings {
        samples: if study.quick { 64 } else { 512 },
        vertices: Some(if study.quick { 300 } else { 2000 }),
        seed,
        ..ReferenceSettings::default()
    };
    let count = settings(0).vertices.unwrap_or(usize::MAX).min(mesh.local.len()) as u64;
    let stage = study.progress.stage("triangles", 4 * count * u64::from(settings(0).batches));
    let tick = |n| stage.tick(n);
    let triangles = SurfaceTracer::new(&study.device, scene, isovalue, 1)?;
    let graph = GraphTracer::new(&study.device, scene)?;
    let on_triangles = |seed| reference(scene, &triangles, mesh, isovalue, &settings(seed), &tick);
    let on_graph = |seed| reference(scene, &graph, mesh, isovalue, &settings(seed), &tick);
    let pairs = [[on_graph(13)?, on_triangles(11)?], [on_graph(14)?, on_triangles(12)?]];
    stage.end()?;
    Ok(displayed_difference(&pairs, scene.exposure()))
}

/// Percent RMS between the displayed colours of the references of a pair, from two pairs that are independent:
/// ⟨(g₁ − t₁)·(g₂ − t₂)⟩ has no noise of its own.
fn displayed_difference(pairs: &[[Reference; 2]; 2], exposure: f64) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for v in (0..pairs[0][0].sampled.len()).filter(|&v| pairs[0][0].sampled[v]) {
        let [a, b] = pairs.each_ref().map(|[g, t]| display(g.radiance[v], exposure) - display(t.radiance[v], exposure));
        sum += a.dot(b);
        count += 1.0;
    }
    percent(sum / f64::max(count, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Exposure 2: 0.4 against 0.2 and 0.6, then white against 3 and 5 times white, then one that is not sampled.
    #[test]
    fn triangles_differ_by_what_is_displayed() {
        let reference = |r: [f64; 3]| Reference {
            radiance: r.map(DVec3::splat).to_vec(),
            sampled: vec![true, true, false],
            ..Reference::default()
        };
        let triangles = || reference([0.2, 0.5, 0.0]);
        let pairs = [[reference([0.1, 1.5, 9.0]), triangles()], [reference([0.3, 2.5, 9.0]), triangles()]];
        assert_eq!(displayed_difference(&pairs, 2.0), 0.0, "−0.2 · 0.2 is negative");
        let pairs = [[reference([0.3, 1.5, 9.0]), triangles()], [reference([0.3, 2.5, 9.0]), triangles()]];
        let expected = 100.0 * (3.0 * 0.2 * 0.2f64 / 2.0).sqrt();
        assert!((displayed_difference(&pairs, 2.0) - expected).abs() < 1e-9);
    }
}
