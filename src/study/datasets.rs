//! The table of data sets: error and seconds with and without final gather, and where the error comes from.

use super::{Effort, Study, Subject, Table, accuracy_of, provenance};
use crate::accuracy::{interpolation_floor, total_floor};
use crate::bake::{BakeOptions, BakeSettings, StrategyName};
use crate::embree::{GraphTracer, SurfaceTracer};
use crate::error::Result;
use crate::reference::{Reference, ReferenceSettings, reference};
use crate::surface_mesh::SurfaceMesh;
use std::time::Instant;

const COLUMNS: [&str; 21] = [
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
    "floor_1x",
    "floor_2x",
    "floor_3x",
    "floor_total",
    "triangles_vs_trilinear",
    "build_s",
    "photons_s",
    "cache_s",
    "samples_s",
    "extract_s",
];

/// Each data set at its main isovalue: from the map (BB09's mode), with final gather, and with samples at the nodes; the
/// interpolation floor at grid factors 1, 2, 3; the reference on triangles against the one on the trilinear surface.
///
/// # Errors
/// As bakes, references and tables.
pub fn datasets(study: &Study, subjects: &[Subject], base: &BakeOptions) -> Result<()> {
    let mut table = Table::open(study.folder.join("datasets.csv"), &COLUMNS, 3)?;
    let modes: [(&str, BakeOptions); 3] = [
        ("map", BakeOptions { gather_rays: Some(0), ..BakeOptions::default() }),
        ("gather", BakeOptions::default()),
        ("nodes", BakeOptions { strategy: Some(StrategyName::Nodes), ..BakeOptions::default() }),
    ];
    for subject in subjects {
        let scene = &subject.scene;
        let c = subject.main_isovalue();
        let key = |mode: &str| vec![subject.name.clone(), mode.to_owned(), format!("{c:.3}")];
        if modes.iter().all(|(mode, _)| table.has(&key(mode))) {
            continue;
        }
        study.say(&format!("{}: isovalue {c:.3}", subject.name));
        let unit = scene.field.sweep().isovalue(c);
        let begun = Instant::now();
        let mesh = SurfaceMesh::extract(scene, unit, 1)?;
        let extract_seconds = begun.elapsed().as_secs_f64();
        let Some(references) = study.references(subject, c, Effort::Table)? else { continue };
        let tracer = GraphTracer::new(&study.device, scene)?;
        let (shadow, vertices) = if study.quick { (64, 300) } else { (1024, 2000) };
        let mut floors = Vec::new();
        for factor in 1..=3 {
            let floor = interpolation_floor(scene, &tracer, &mesh, unit, factor, shadow, Some(vertices))?;
            floors.push(floor.percent_rms);
        }
        let paths = if study.quick { 64 } else { 256 };
        let total = total_floor(scene, &tracer, &mesh, &references, 1, paths, vertices)?;
        let triangles = triangle_error(study, subject, &mesh, unit)?;
        for (mode, options) in &modes {
            if table.has(&key(mode)) {
                continue;
            }
            let settings = BakeSettings::new(&options.clone().or(base))?;
            let (bake, _) = study.bake(subject, &settings)?;
            let a = accuracy_of(&bake, &references)?;
            let s = bake.report.seconds;
            let [nx, ny, nz] = bake.lattice.dims();
            let mut row = key(mode);
            row.extend([format!("{nx}x{ny}x{nz}"), settings.photons.to_string(), bake.report.samples.to_string()]);
            let numbers = [
                a.percent_rms,
                a.confidence[0],
                a.confidence[1],
                a.percent_rms_area,
                a.percent_rms_lit,
                floors[0],
                floors[1],
                floors[2],
                total,
                triangles,
                s.build,
                s.photons,
                s.cache,
                s.samples + s.interpolate,
                extract_seconds,
            ];
            row.extend(numbers.map(|x| format!("{x:.4}")));
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

/// Percent RMS between references traced through triangles and through the trilinear surface, without their noise.
fn triangle_error(study: &Study, subject: &Subject, mesh: &SurfaceMesh, isovalue: f32) -> Result<f64> {
    let scene = &subject.scene;
    let settings = |seed| ReferenceSettings {
        samples: if study.quick { 64 } else { 512 },
        vertices: Some(if study.quick { 300 } else { 2000 }),
        seed,
        ..ReferenceSettings::default()
    };
    let quiet = |_| true;
    let triangles = SurfaceTracer::new(&study.device, scene, isovalue, 1)?;
    let graph = GraphTracer::new(&study.device, scene)?;
    let on_triangles = |seed| reference(scene, &triangles, mesh, isovalue, &settings(seed), &quiet);
    let on_graph = |seed| reference(scene, &graph, mesh, isovalue, &settings(seed), &quiet);
    // Four independent runs: ⟨(g₁ − t₁)·(g₂ − t₂)⟩ has no noise of its own.
    let (t1, t2, g1, g2) = (on_triangles(11), on_triangles(12), on_graph(13), on_graph(14));
    let exposure = scene.exposure();
    let (mut sum, mut count) = (0.0, 0.0);
    for v in (0..mesh.local.len()).filter(|&v| t1.sampled[v]) {
        let d = |a: &crate::reference::Reference, b: &Reference| (a.radiance[v] - b.radiance[v]) * exposure;
        sum += d(&g1, &t1).dot(d(&g2, &t2));
        count += 1.0;
    }
    Ok(100.0 * (sum / f64::max(count, 1.0)).max(0.0).sqrt())
}
