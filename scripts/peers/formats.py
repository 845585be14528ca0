"""Checks every reader and writer of isolume against the tools people use.

    python scripts/peers/formats.py path/to/isolume [folder with volumes]

Readers: another tool writes a volume, isolume reads it, and lattice and samples must agree. Writers: isolume writes a grid that
holds (x, y, z) as its light, another tool reads it, and what it finds at the vertices of a contour must be where they are, to
1e-6 of the extent. Prints one line per check; exit code 1 if one fails.
"""

import gzip
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import mrcfile
import nibabel
import nrrd
import numpy as np
import OpenEXR
import pyvista
import SimpleITK as sitk
import tifffile
import trimesh
import vtk
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

ISOLUME = str(pathlib.Path(sys.argv[1]).resolve())
DATA = pathlib.Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else None
failures = 0


def isolume(*args):
    done = subprocess.run([ISOLUME, *map(str, args)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"isolume {' '.join(map(str, args))}: {done.stderr.strip()}")
    return done.stdout


def report(name, error, limit):
    global failures
    good = error <= limit
    failures += not good
    print(f"{'ok  ' if good else 'FAIL'} {name:58s} {error:.2e}  (at most {limit:.0e})", flush=True)


def check(name, limit=0.0):
    """Runs a function that returns an error, and reports it."""

    def run(f):
        try:
            report(name, float(f()), limit)
        except Exception as e:
            report(f"{name}: {type(e).__name__}: {e}", float("inf"), limit)

    return run


# The lattice of all checks: oblique, anisotropic, flipped. The columns of AXES are world steps per index.
SHAPE = (11, 8, 6)
ORIGIN = np.array([20.0, -7.0, 3.0])
ROTATION = np.linalg.qr(np.array([[0.9, 0.3, 0.1], [-0.2, 0.8, 0.4], [0.1, -0.5, 0.9]]))[0]
ROTATION[:, 0] *= -1
SPACING = np.array([0.7, 1.3, 2.1])
OBLIQUE = ROTATION * SPACING
ALIGNED = np.diag(SPACING)
rng = np.random.default_rng(1)


def samples(dtype):
    """Random samples as a[x, y, z]."""
    if np.issubdtype(dtype, np.floating):
        return rng.normal(size=SHAPE).astype(dtype)
    i = np.iinfo(dtype)
    return rng.integers(max(i.min, -(2**20)), min(i.max, 2**20), SHAPE).astype(dtype)


def read_error(path, expected, origin, axes, *args):
    """Largest deviation of samples (in their own units) and lattice (in world units) of what isolume reads."""
    out = f"{path}.check.npy"
    isolume("export", path, "-o", out, "-q", *args)
    found = np.load(out).transpose(2, 1, 0)
    if found.shape != expected.shape:
        raise ValueError(f"shape {found.shape}, not {expected.shape}")
    info = json.loads(isolume("info", path, "--json", *args))
    lattice = max(abs(np.array(info["origin"]) - origin).max(), abs(np.array(info["axes"]).T - axes).max())
    values = abs(found.astype(float) - expected.astype(float)).max()
    return max(lattice, values)


def to_itk(a, axes, origin=ORIGIN):
    image = sitk.GetImageFromArray(np.ascontiguousarray(a.transpose(2, 1, 0)))
    spacing = np.linalg.norm(axes, axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(origin.tolist())
    image.SetDirection((axes / spacing).flatten().tolist())
    return image


def to_vtk(a, axes, origin=ORIGIN):
    image = vtk.vtkImageData()
    image.SetDimensions(a.shape)
    spacing = np.linalg.norm(axes, axis=0)
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    image.SetDirectionMatrix((axes / spacing).flatten())
    array = numpy_to_vtk(a.flatten(order="F"), deep=True)
    array.SetName("h")
    image.GetPointData().SetScalars(array)
    return image


def readers():
    for dtype in (np.uint8, np.int16, np.uint16, np.int32, np.float32, np.float64):
        for name, packed in (("a.mha", True), ("b.mha", False), ("c.mhd", True), ("d.mhd", False)):
            a = samples(dtype)

            @check(f"SimpleITK → {name} {np.dtype(dtype)}{' zlib' if packed else ''}", 1e-12)
            def _():
                sitk.WriteImage(to_itk(a, OBLIQUE), name, packed)
                return read_error(name, a, ORIGIN, OBLIQUE)

        a = samples(dtype)

        @check(f"SimpleITK → .nrrd {np.dtype(dtype)}", 1e-12)
        def _():
            sitk.WriteImage(to_itk(a, OBLIQUE), "a.nrrd", True)
            return read_error("a.nrrd", a, ORIGIN, OBLIQUE)

        @check(f"pynrrd → .nrrd {np.dtype(dtype)}", 1e-12)
        def _():
            header = {"space": "LPS", "space directions": OBLIQUE.T, "space origin": ORIGIN}
            nrrd.write("p.nrrd", a, header)
            return read_error("p.nrrd", a, ORIGIN, OBLIQUE)

        for binary in (True, False):

            @check(f"VTK → legacy .vtk {'binary' if binary else 'ascii'} {np.dtype(dtype)}", 1e-5)
            def _():
                image = to_vtk(a, ALIGNED)
                writer = vtk.vtkStructuredPointsWriter()
                writer.SetFileName("a.vtk")
                writer.SetInputData(image)
                writer.SetFileTypeToBinary() if binary else writer.SetFileTypeToASCII()
                writer.Write()
                return read_error("a.vtk", a, ORIGIN, ALIGNED)

        for mode in ("Appended", "Binary", "Ascii"):

            @check(f"VTK → .vti {mode.lower()} {np.dtype(dtype)}", 1e-5 if mode == "Ascii" else 1e-12)
            def _():
                writer = vtk.vtkXMLImageDataWriter()
                writer.SetFileName("a.vti")
                writer.SetInputData(to_vtk(a, OBLIQUE))
                getattr(writer, f"SetDataModeTo{mode}")()
                writer.Write()
                return read_error("a.vti", a, ORIGIN, OBLIQUE)

        for order in "CF":
            for endian in "<>":

                @check(f"NumPy → .npy {order} {endian} {np.dtype(dtype)}")
                def _():
                    # C order is indexed [z, y, x], Fortran order [x, y, z].
                    b = np.asfortranarray(a) if order == "F" else np.ascontiguousarray(a.transpose(2, 1, 0))
                    np.save("a.npy", b.astype(b.dtype.newbyteorder(endian), order="K"))
                    return read_error("a.npy", a, np.zeros(3), np.eye(3))

        if dtype != np.int32 and dtype != np.float64:

            @check(f"nibabel → .nii.gz {np.dtype(dtype)}", 1e-5)
            def _():
                affine = np.eye(4)
                affine[:3, :3], affine[:3, 3] = OBLIQUE, ORIGIN
                nibabel.save(nibabel.Nifti1Image(a, affine), "a.nii.gz")
                return read_error("a.nii.gz", a, ORIGIN, OBLIQUE)

    for dtype in (np.uint8, np.uint16, np.float32, np.float16, np.float64):
        for kind in ("imagej", "ome", "plain", "zlib"):
            if (kind, dtype) in (("imagej", np.float16), ("imagej", np.float64), ("ome", np.float16)):
                continue  # those programs know no such samples
            a = samples(np.float32).astype(dtype) if np.issubdtype(dtype, np.floating) else samples(dtype)

            @check(f"tifffile → .tif {kind} {np.dtype(dtype)}", 1e-6)
            def _():
                pages = np.ascontiguousarray(a.transpose(2, 1, 0))
                name, axes = "a.tif", np.eye(3)
                if kind == "imagej":
                    axes = np.diag([0.25, 0.5, 1.5])
                    tifffile.imwrite(name, pages, imagej=True, resolution=(4.0, 2.0), metadata={"spacing": 1.5, "unit": "um", "axes": "ZYX"})
                elif kind == "ome":
                    name, axes = "a.ome.tif", ALIGNED
                    sizes = {f"PhysicalSize{c}": s for c, s in zip("XYZ", SPACING)}
                    tifffile.imwrite(name, pages, metadata={"axes": "ZYX", **sizes})
                elif kind == "plain":
                    tifffile.imwrite(name, pages, photometric="minisblack", metadata=None)
                else:
                    tifffile.imwrite(name, pages, photometric="minisblack", compression="zlib", predictor=False)
                return read_error(name, a, np.zeros(3), axes)

    for mode, dtype in ((0, np.int8), (1, np.int16), (2, np.float32), (6, np.uint16), (12, np.float16)):
        a = samples(dtype)

        @check(f"mrcfile → .mrc mode {mode}", 1e-5)
        def _():
            with mrcfile.new("a.mrc", overwrite=True) as f:
                f.set_data(np.ascontiguousarray(a.transpose(2, 1, 0)))
                f.set_volume()
                f.voxel_size = tuple(SPACING)
                f.header.origin = tuple(ORIGIN)
            return read_error("a.mrc", a, ORIGIN, ALIGNED)

    @check("mrcfile → .map.gz with columns along z, NSTART", 1e-5)
    def _():
        a = samples(np.float32)
        with mrcfile.new("a.map.gz", compression="gzip", overwrite=True) as f:
            f.set_data(np.ascontiguousarray(a.transpose(2, 1, 0)))
            f.set_volume()
            h = f.header
            # Columns run along z, rows along x, sections along y; intervals and cell are by crystal axis.
            h.mapc, h.mapr, h.maps = 3, 1, 2
            h.mx, h.my, h.mz = SHAPE[1], SHAPE[2], SHAPE[0]
            h.cella.x, h.cella.y, h.cella.z = SPACING * (h.mx, h.my, h.mz)
            h.nxstart, h.nystart, h.nzstart = 4, 5, 6
        axes = ALIGNED[:, [2, 0, 1]]
        return read_error("a.map.gz", a, axes @ [4, 5, 6], axes)


def data_files():
    """The volumes of a folder, as another tool reads them."""

    def itk(name):
        image = sitk.ReadImage(str(DATA / name))
        spacing = np.array(image.GetSpacing())
        a = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
        return a, np.array(image.GetOrigin()), np.array(image.GetDirection()).reshape(3, 3) * spacing

    def by_vtk(reader, name, scale=1.0):
        reader.SetFileName(str(DATA / name))
        reader.Update()
        image = reader.GetOutputDataObject(reader.GetNumberOfOutputPorts() - 1)
        a = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(image.GetDimensions(), order="F")
        return a, scale * np.array(image.GetOrigin()), scale * np.diag(image.GetSpacing())

    def cube(name):
        text = gzip.open(DATA / name, "rt").read().split("\n")
        head = [np.array(line.split(), float) for line in text[2:6]]
        atoms = int(head[0][0])
        dims = [int(h[0]) for h in head[1:]]
        a = np.array(" ".join(text[6 + atoms :]).split(), float).reshape(dims)
        return a, head[0][1:4], np.array([h[1:4] for h in head[1:]]).T

    def tif(name):
        import io
        import zipfile

        path = DATA / name
        if name.endswith(".zip"):
            archive = zipfile.ZipFile(path)
            path = io.BytesIO(archive.read(archive.namelist()[0]))
        with tifffile.TiffFile(path) as f:
            a = f.asarray().transpose(2, 1, 0)
            axes = np.eye(3)
            if f.is_imagej:
                n, d = f.pages[0].tags["XResolution"].value
                axes = np.diag([d / n, d / n, f.imagej_metadata.get("spacing", 1.0)])
        return a, np.zeros(3), axes

    def nii(name):
        image = nibabel.load(DATA / name)
        return np.asarray(image.dataobj), image.affine[:3, 3], image.affine[:3, :3]

    def mrc(name):
        with mrcfile.open(DATA / name) as f:
            v = f.voxel_size
            return f.data.transpose(2, 1, 0), np.zeros(3), np.diag([float(v.x), float(v.y), float(v.z)])

    for name, read in {
        "acrolein1gs.cube.gz": cube,
        "aneurism.vti": lambda n: by_vtk(vtk.vtkXMLImageDataReader(), n),
        "betaGal.mrc": mrc,
        "ch2.nii.gz": nii,
        "engine.vti": lambda n: by_vtk(vtk.vtkXMLImageDataReader(), n),
        "ironProt.vtk": lambda n: by_vtk(vtk.vtkStructuredPointsReader(), n),
        "neuron.mha": itk,
        "neuron.tif.zip": tif,
        "nuclear_envelope.tif": tif,
        "nucleon.nrrd": itk,
        "walnut.mhd": itk,
    }.items():
        if not (DATA / name).exists():
            print(f"skip {name}: not in {DATA}")
            continue

        @check(f"the same as the peer reads: {name}", 1e-5)
        def _():
            a, origin, axes = read(name)
            copy = pathlib.Path(name)
            if not copy.exists():
                for extra in {name, name.replace(".nrrd", ".raw"), name.replace(".mhd", ".raw")}:
                    os.symlink(DATA / extra, extra)
            return read_error(name, a, origin, axes)


def contour(image):
    """The contour of `value` at 3. VTK's vtkContourFilter leaves the direction of oblique images aside; this filter does not."""
    edges = vtk.vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetInputArrayToProcess(0, 0, 0, vtk.vtkDataObject.FIELD_ASSOCIATION_POINTS, "value")
    edges.SetValue(0, 3.0)
    edges.InterpolateAttributesOn()
    edges.Update()
    return pyvista.wrap(edges.GetOutput())


def registered():
    """A bake-shaped .vti whose light is (x, y, z), and its contour by VTK."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), -1)
    world = index @ OBLIQUE.T + ORIGIN
    centre = (np.array(SHAPE) - 1) / 2 @ OBLIQUE.T + ORIGIN
    image = to_vtk(np.linalg.norm(world - centre, axis=-1).astype(np.float32), OBLIQUE)
    image.GetPointData().GetScalars().SetName("value")
    light = numpy_to_vtk(world.astype(np.float32).reshape(-1, 3, order="F"), deep=True)
    light.SetName("radiance")
    image.GetPointData().AddArray(light)
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName("xyz.vti")
    writer.SetInputData(image)
    writer.Write()
    points = np.array(contour(image).points, float)
    return points, np.ptp(world.reshape(-1, 3), axis=0).max()


def trilinear(grid, index):
    """grid[x, y, z, c] at index coordinates."""
    cell = np.clip(index.astype(int), 0, np.array(grid.shape[:3]) - 2)
    u = index - cell
    out = 0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, u, 1 - u), axis=1)
        out = out + weight[:, None] * grid[tuple((cell + corner).T)].astype(float)
    return out


def grids():
    points, extent = registered()
    index = np.linalg.solve(OBLIQUE, (points - ORIGIN).T).T
    off = lambda found: abs(found - points).max() / extent
    for extension in ("vti", "nrrd", "npy", "exr"):
        isolume("export", "xyz.vti", "--array", "radiance", "-o", f"r.{extension}", "-q")
    isolume("export", "xyz.vti", "--array", "value", "-o", "value.vti", "-q")

    @check(".nrrd vectors → SimpleITK, at a contour", 1e-6)
    def _():
        image = sitk.ReadImage("r.nrrd")
        assert image.GetNumberOfComponentsPerPixel() == 3 and image.GetDimension() == 3
        a = sitk.GetArrayFromImage(image).transpose(2, 1, 0, 3)
        i = [image.TransformPhysicalPointToContinuousIndex(p.tolist()) for p in points]
        return off(trilinear(a, np.array(i)))

    @check(".nrrd vectors → pynrrd, at a contour", 1e-6)
    def _():
        a, header = nrrd.read("r.nrrd")
        assert header["kinds"] == ["vector", "domain", "domain", "domain"] and header["space"] == "left-posterior-superior"
        assert np.isnan(header["space directions"][0]).all()
        axes = np.array(header["space directions"][1:]).T
        i = np.linalg.solve(axes, (points - header["space origin"]).T).T
        return off(trilinear(a.transpose(1, 2, 3, 0), i))

    @check(".npy → NumPy, at a contour", 1e-6)
    def _():
        return off(trilinear(np.load("r.npy").transpose(2, 1, 0, 3), index))

    @check(".exr → OpenEXR, at a contour", 1e-6)
    def _():
        with OpenEXR.File("r.exr", separate_channels=True) as f:
            slices = [np.stack([part.channels[c].pixels for c in "RGB"], -1) for part in f.parts]
            names = [part.name() for part in f.parts]
        assert names == [f"z{k:04}" for k in range(SHAPE[2])]
        return off(trilinear(np.array(slices).transpose(2, 1, 0, 3), index))

    @check(".vti → PyVista, light at the vertices of its contour", 1e-6)
    def _():
        image = pyvista.read("r.vti")
        image["value"] = pyvista.read("value.vti")["value"]
        found = contour(image)
        assert abs(np.array(found.points) - points).max() < 1e-5
        return off(found["radiance"])

    @check("value.vti → VTK's contour is the same", 1e-6)
    def _():
        return off(np.array(contour(pyvista.read("value.vti")).points, float))


def meshes():
    """Surfaces of a real bake, against VTK's lookup in it."""
    isolume("generate", "bumps", "--size", 25, "-o", "b.vti", "-q")
    isolume("bake", "b.vti", "--isovalues", 3.6, 95, "--preset", "preview", "-o", "lit.vti", "-q")
    for extension in ("ply", "obj", "glb", "vtp"):
        isolume("extract", "lit.vti", "--isovalue", 47, "-o", f"m.{extension}", "-q")
    vtp = pyvista.read("m.vtp")
    points, triangles = np.array(vtp.points, float), vtp.faces.reshape(-1, 4)[:, 1:]
    probed = vtp.sample(pyvista.read("lit.vti"))
    exposure = float(pyvista.read("lit.vti").field_data["exposure"][0])

    def srgb(x):
        x = np.clip(x, 0, 1)
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)

    colours = srgb(probed["radiance"].astype(float) * exposure)

    @check(".vtp: light as VTK's probe finds it in the bake", 1e-6)
    def _():
        return abs(vtp["radiance"] - probed["radiance"]).max() / probed["radiance"].max()

    @check(".vtp: rgb bytes, normals of length 1 and outward", 1.01 / 255)
    def _():
        assert vtp.GetPointData().GetScalars().GetName() == "rgb" and vtp.GetPointData().GetNormals() is not None
        face = np.cross(*(points[triangles[:, i]] - points[triangles[:, 0]] for i in (1, 2)))
        cosine = (face * vtp["Normals"][triangles[:, 0]]).sum(1) / np.linalg.norm(face, axis=1)
        assert abs(np.linalg.norm(vtp["Normals"], axis=1) - 1).max() < 1e-5 and (cosine > 0).mean() > 0.99
        return abs(vtp["rgb"] / 255 - colours).max()

    def same(name, mesh, found, limit, turn=np.eye(3), shift=np.zeros(3)):
        @check(f"{name}: vertices, triangles", 1e-6)
        def _():
            assert (np.asarray(mesh.faces) == triangles).all()
            return abs((np.asarray(mesh.vertices) + shift) @ turn.T - points).max()

        @check(f"{name}: normals", 1e-5)
        def _():
            return abs(np.asarray(mesh.vertex_normals) @ turn.T - vtp["Normals"]).max()

        @check(f"{name}: colours", limit)
        def _():
            return abs(found() - colours).max()

    for kind in ("ply", "obj"):
        mesh = trimesh.load(f"m.{kind}", process=False, maintain_order=True)
        same(f".{kind} → trimesh", mesh, lambda: mesh.visual.vertex_colors[:, :3] / 255, 1.01 / 255)
    scene = trimesh.load("m.glb", process=False)
    (mesh,) = scene.geometry.values()
    (node,) = scene.graph.nodes_geometry
    matrix = scene.graph[node][0]
    # glTF's y is up, the world's z.
    up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ matrix[:3, :3]
    assert (up == np.eye(3)).all()
    shift = matrix[:3, :3].T @ matrix[:3, 3]
    same(".glb → trimesh", mesh, lambda: srgb(mesh.visual.vertex_attributes["color"]), 1e-5, shift=shift)
    ply = pyvista.read("m.ply")

    @check(".ply → VTK: vertices and RGB", 1e-6)
    def _():
        return max(abs(np.array(ply.points) - points).max(), abs(ply["RGB"] / 255.0 - vtp["rgb"] / 255.0).max())

    @check(".glb → VTK: vertices, and linear colours as floats", 1e-6)
    def _():
        reader = vtk.vtkGLTFReader()
        reader.SetFileName("m.glb")
        reader.Update()
        found = pyvista.wrap(reader.GetOutput()).combine().extract_surface(algorithm="dataset_surface")
        order = lambda p: np.lexsort(np.round(p, 5).T)
        # glTF's y is up, the world's z.
        a, b = np.array(found.points, float) * (1, 1, -1), points
        a = a[:, [0, 2, 1]]
        colour = found["COLOR_0"][order(a), :3]
        expected = np.clip(probed["radiance"].astype(float) * exposure, 0, 1)[order(b)]
        return max(abs(a[order(a)] - b[order(b)]).max(), abs(colour - expected).max())


def main():
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        readers()
        grids()
        meshes()
        if DATA:
            data_files()
    print(f"{failures} failed")
    sys.exit(failures > 0)


main()
