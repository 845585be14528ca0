//! What a lattice can hold at all.

use super::{bumps, device};
use isolume::accuracy::{InterpolationFloor, ReferenceMesh};
use isolume::embree::GraphTracer;
use isolume::illumination_grid::GridSize;
use isolume::reference::{ReferenceSettings, reference};
use isolume::surface_mesh::SurfaceMesh;

#[test]
fn the_interpolation_floor_falls_with_the_grid() {
    let (scene, device) = (bumps(41), device());
    let c = scene.field.sweep().isovalue(47.0);
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let floor = |factor| {
        let grid = GridSize::Factors([factor; 3]);
        let floor = InterpolationFloor { scene: &scene, tracer: &tracer, mesh: &mesh, grid };
        [32, 1024].map(|rays| floor.direct(c, rays, Some(300)).unwrap())
    };
    let ([_, coarse], [noisy, fine]) = (floor(1), floor(3));
    assert!(fine < 0.7 * coarse && coarse < 5.0 && fine > 0.0, "{coarse} {fine}");
    // A few rays tell the same, less surely: their own noise is ten times as much.
    assert!(noisy < 2.0 * fine, "{noisy} {fine}");
}

/// Of all light, few paths at the grid's points find the same floor as many, whose own noise is an eighth of theirs.
#[test]
fn the_floor_of_all_light_is_free_of_noise() {
    let (scene, device) = (bumps(17), device());
    let c = scene.field.sweep().isovalue(47.0);
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let references = [1, 2].map(|seed| {
        let settings = ReferenceSettings { samples: 256, batches: 2, seed, ..Default::default() };
        let made = reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
        ReferenceMesh {
            positions: mesh.positions.clone(),
            triangles: mesh.triangles.clone(),
            radiance: made.radiance,
            variance: Some(made.variance),
            sampled: made.sampled,
        }
    });
    let floor = InterpolationFloor { scene: &scene, tracer: &tracer, mesh: &mesh, grid: GridSize::OWN };
    let [few, many] = [4, 256].map(|paths| floor.total(&references, paths, 400).unwrap());
    assert!((few / many - 1.0).abs() < 0.35, "{few} {many}");
}
