#!/usr/bin/env python3
"""The extracted mesh in the same box, path-traced by Mitsuba 3: an independent referee.

  python3 scripts/peers/mitsuba3.py ISOLUME FOLDER [--vertices 1500] [--samples 1024]

Per scene: radiance at the vertices against `isolume reference` by z-test (Šidák over all vertices), against a bake by
`isolume compare` with two Mitsuba references, and what Mitsuba's `sdfgrid` traces per second beside `isolume`'s engine.
Needs scripts/peers/requirements.txt and LLVM 16 or later (the newest in /usr/lib, or DRJIT_LIBLLVM_PATH).
Exit code 1 if a test fails.
"""

import argparse
import glob
import json
import math
import os
import pathlib
import re
import subprocess
import sys
import time

import numpy as np
import mitsuba as mi
import nrrd

# LLVM before 16 ends the process at an instruction that it does not know.
found = {int(re.search(r"(?:-|so\.)(\d+)", f)[1]): f for f in glob.glob("/usr/lib/*/libLLVM[-.]*[0-9]*") if re.search(r"(?:-|so\.)(\d+)", f)}
if "DRJIT_LIBLLVM_PATH" not in os.environ:
    if max(found, default=0) < 16:
        print("Mitsuba 3: skipped, since there is no LLVM 16 or later; install libllvm19 or set DRJIT_LIBLLVM_PATH")
        sys.exit(0)
    os.environ["DRJIT_LIBLLVM_PATH"] = found[max(found)]
mi.set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402

try:
    dr.eval(dr.arange(mi.Float, 4) + 1)
except Exception as e:
    print(f"Mitsuba 3: skipped, since it finds no LLVM that it accepts ({e}); install libllvm19 and set DRJIT_LIBLLVM_PATH")
    sys.exit(0)

from plyfile import PlyData, PlyElement  # noqa: E402
from scipy.stats import norm  # noqa: E402

RED, GREEN, WHITE = [0.63, 0.065, 0.05], [0.14, 0.45, 0.091], [0.725, 0.71, 0.68]
SURFACE = 0.75
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# name, generator, size, sweep, isovalue: all on the unit cube, in the default box.
SCENES = [
    ("bumps", "bumps", 65, (3.6, 95.0), 47.0),
    ("two-cylinders", "two-cylinders", 65, (0.1, 1.0), 0.5),
    ("plane", "linear:0.5,0.2,-1", 33, (-0.9, 0.6), -0.1),
]


def quad(corners, albedo, emission=None):
    """A rectangle with corners a, b, c, d, its front towards (b - a) x (d - a)."""
    a, b, _, d = (np.array(p, float) for p in corners)
    u, v = (b - a) / 2, (d - a) / 2
    n = np.cross(u, v)
    n /= np.linalg.norm(n)
    m = np.eye(4)
    m[:3, 0], m[:3, 1], m[:3, 2], m[:3, 3] = u, v, n, a + u + v
    out = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(m),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
    }
    if emission:
        out["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": [emission] * 3}}
    return out


def box():
    """The default scene on the unit cube: walls seen from inside, y_min open, a luminaire that faces down."""
    return {
        "red": quad([(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], RED),
        "green": quad([(1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0)], GREEN),
        "floor": quad([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], WHITE),
        "ceiling": quad([(0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1)], WHITE),
        "back": quad([(0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)], WHITE),
        "light": quad([(0.3, 0.3, 0.999), (0.3, 0.7, 0.999), (0.7, 0.7, 0.999), (0.7, 0.3, 0.999)], [0, 0, 0], 1.0),
    }


def run(*command):
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit code {result.returncode}\n{result.stderr}")
    return result.stdout


def outgoing(scene, integrator, x, n, samples, seed):
    """Radiance that leaves Lambertian vertices x with normals n: direct by emitter sampling, indirect by paths."""
    count = len(x)
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(seed, count * samples)
    rep = np.repeat(np.arange(count), samples)
    p, m = mi.Point3f(np.ascontiguousarray(x[rep].T)), mi.Normal3f(np.ascontiguousarray(n[rep].T))
    origin = p + 1e-5 * m
    si = dr.zeros(mi.SurfaceInteraction3f, count * samples)
    si.p, si.n, si.sh_frame, si.t = origin, m, mi.Frame3f(m), 1.0
    light, weight = scene.sample_emitter_direction(si, sampler.next_2d(), True)
    cosine = dr.maximum(dr.dot(light.d, m), 0)
    direct = weight * cosine * SURFACE / math.pi
    d = mi.Frame3f(m).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    ray = mi.RayDifferential3f(mi.Ray3f(origin, d))
    met = scene.ray_intersect(mi.Ray3f(ray))
    active = met.is_valid() & (met.emitter(scene) == None)  # noqa: E711
    indirect, _, _ = integrator.sample(scene, sampler, ray, None, active)
    total = direct + dr.select(active, indirect, 0) * SURFACE
    return np.array(total).T.reshape(count, samples, 3).mean(axis=1)


def referee(scene, integrator, x, n, samples, seed, batches=16):
    each = [outgoing(scene, integrator, x, n, samples // batches, seed * 1000 + b) for b in range(batches)]
    each = np.array(each)
    return each.mean(axis=0), each.var(axis=0, ddof=1) / batches


def write_reference(path, mesh, chosen, mean, variance):
    """As `isolume reference` writes it, so that `isolume compare` reads it."""
    v = mesh["vertex"]
    names = ["x", "y", "z"] + [f"{k}_{c}" for k in ("radiance", "variance") for c in "rgb"] + ["sampled"]
    rows = np.zeros(v.count, dtype=[(name, "f4") for name in names])
    for a in "xyz":
        rows[a] = v[a]
    for i, c in enumerate("rgb"):
        rows[f"radiance_{c}"][chosen], rows[f"variance_{c}"][chosen] = mean[:, i], variance[:, i]
    rows["sampled"][chosen] = 1
    PlyData([PlyElement.describe(rows, "vertex"), mesh["face"]]).write(str(path))


def sdf_rate(values, isovalue, rays=1 << 21):
    """Closest hits per second of Mitsuba's sdfgrid, rays from random points of the cube in random directions."""
    grid = mi.TensorXf(np.ascontiguousarray((isovalue - values)[..., None]).astype(np.float32))
    scene = mi.load_dict({"type": "scene", "s": {"type": "sdfgrid", "grid": grid, "normals": "smooth"}})
    rng = np.random.default_rng(1)
    o, d = rng.random((3, rays)), rng.standard_normal((3, rays))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d / np.linalg.norm(d, axis=0)))
    best = math.inf
    for _ in range(4):
        begun = time.perf_counter()
        hit = scene.ray_intersect_preliminary(ray, coherent=False)
        dr.eval(hit.t)
        dr.sync_thread()
        best = min(best, time.perf_counter() - begun)
    return rays / best


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("isolume", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--preset", default="standard")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    binary = args.isolume.resolve()
    os.chdir(args.folder)
    integrator = mi.load_dict({"type": "path", "max_depth": 64, "rr_depth": 8})
    failed = False
    for name, generator, size, sweep, isovalue in SCENES:
        volume, ours, bake = f"{name}.vti", f"{name}-isolume.ply", f"{name}-bake.vti"
        run(binary, "generate", generator, "--size", size, "-o", volume)
        scene_args = ["--isovalues", *sweep]
        run(binary, "extract", volume, "--isovalue", isovalue, "-o", f"{name}.ply", *scene_args)
        begun = time.perf_counter()
        run(binary, "reference", volume, "--isovalue", isovalue, "-o", ours, "--vertices", args.vertices,
            "--samples", args.samples, *scene_args)
        our_seconds = time.perf_counter() - begun
        run(binary, "bake", volume, "-o", bake, "--preset", args.preset, "--quiet", *scene_args)
        mesh, reference = PlyData.read(f"{name}.ply"), PlyData.read(ours)["vertex"]
        v = mesh["vertex"]
        # A vertex in a wall's own plane sees that wall at distance 0, or does not, by rounding.
        inside = np.all([(v[a] > 1e-3) & (v[a] < 1 - 1e-3) for a in "xyz"], axis=0)
        chosen = np.flatnonzero((reference["sampled"] > 0) & inside)
        x = np.stack([v[a][chosen] for a in "xyz"], axis=1)
        n = np.stack([v[a][chosen] for a in ("nx", "ny", "nz")], axis=1)
        surface = {
            "type": "ply",
            "filename": f"{name}.ply",
            "bsdf": {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [SURFACE] * 3}}},
        }
        scene = mi.load_dict({"type": "scene", "surface": surface, **box()})
        begun = time.perf_counter()
        means = []
        for seed in (1, 2):
            mean, variance = referee(scene, integrator, x, n, args.samples, seed)
            means.append((mean, variance))
            write_reference(f"{name}-mitsuba{seed}.ply", PlyData.read(ours), chosen, mean, variance)
        their_seconds = (time.perf_counter() - begun) / 2
        mean, variance = means[0]
        l = np.stack([reference[f"radiance_{c}"][chosen] for c in "rgb"], axis=1)
        s = np.stack([reference[f"variance_{c}"][chosen] for c in "rgb"], axis=1)
        deviation = np.hypot(np.sqrt(s) @ LUMINANCE, np.sqrt(variance) @ LUMINANCE)
        z = ((mean - l) @ LUMINANCE) / np.maximum(deviation, 1e-9)
        level = norm.ppf(1 - (1 - 0.99 ** (1 / len(z))) / 2)
        accepted = float(np.mean(np.abs(z) < level))
        bias = float(((mean - l) @ LUMINANCE).mean() / (l @ LUMINANCE).mean())
        compared = json.loads(run(binary, "compare", bake, f"{name}-mitsuba1.ply", f"{name}-mitsuba2.ply", "--json"))
        ok = accepted >= 0.9975 and abs(bias) < 0.005
        failed |= not ok
        print(f"{name}: {len(z)} vertices, |z| < {level:.2f} for {100 * accepted:.2f} %, mean z {z.mean():+.3f}, "
              f"ours low by {100 * bias:+.3f} %: {'agree' if ok else 'DISAGREE'}; reference {our_seconds:.1f} s, "
              f"Mitsuba {their_seconds:.1f} s; bake against Mitsuba {compared['percent_rms']:.3f} % RMS "
              f"{[round(b, 3) for b in compared['confidence']]}", flush=True)
    run(binary, "generate", "bumps", "--size", 101, "-o", "bumps101.nrrd")
    values = nrrd.read("bumps101.nrrd")[0].transpose(2, 1, 0)
    print(f"sdfgrid, bumps 101³ at 47, random rays: {sdf_rate(values, 47.0) / 1e6:.2f} Mrays/s "
          "(beside it: cargo bench --bench intersect, bumps, 'random fixed c')")
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
