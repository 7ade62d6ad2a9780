"""Open3D reads our PLY, NPZ and GLB files: `check_open3d.py FOLDER`."""

import numpy as np
import open3d as o3d

import checks


def main():
    c = checks.Checks(checks.folder_argument())
    for entry in c.files("ply"):
        check_ply(c, entry)
    for entry in c.files("npz"):
        check_npz(c, entry)
    for entry in c.files("glb"):
        check_glb(c, entry)
    c.finish("Open3D")


def check_ply(c, entry):
    path = str(c.folder / entry["path"])
    cloud = o3d.t.io.read_point_cloud(path)
    where = entry["path"]
    c.equal(f"{where}: points", len(cloud.point.positions), entry["vertices"])
    for name, column in entry["columns"].items():
        # Columns of scalars arrive as such; a feature matrix is its columns side by side.
        names = {"positions": ["positions"], "normals": ["normals"], "colors": ["colors"]}.get(name)
        if names is None:
            prefix = entry.get("prefix", "")
            dims = range(column["dim"])
            names = [f"{prefix}{name}_{d:03}" for d in dims] if column["feature"] else [prefix + name]
        c.names(where, cloud.point, names)
        found = [cloud.point[n].numpy() for n in names if n in cloud.point]
        if found:
            c.column(f"{where}: {name}", np.concatenate(found, axis=1), column)
    if entry["faces"]:
        mesh = o3d.io.read_triangle_mesh(path)
        c.equal(f"{where}: mesh vertices", len(mesh.vertices), entry["vertices"])
        c.equal(f"{where}: triangles", len(mesh.triangles), entry["faces"])
        if entry["watertight"] is not None:
            c.equal(f"{where}: watertight", mesh.is_watertight(), entry["watertight"])


def check_npz(c, entry):
    where = entry["path"]
    with np.load(c.folder / where) as arrays:
        c.equal(f"{where}: rows (numpy)", len(arrays["positions"]), entry["vertices"])
        for name, column in entry["columns"].items():
            c.names(f"{where} (numpy)", arrays.files, [name])
            if name in arrays.files:
                c.column(f"{where}: {name} (numpy)", arrays[name], column)
        if entry["faces"]:
            c.equal(f"{where}: triangles (numpy)", arrays["triangles"].shape, (entry["faces"], 3))
            return  # Open3D's point-cloud reader wants one row per point in every array.
    cloud = o3d.t.io.read_point_cloud(str(c.folder / where))
    for name, column in entry["columns"].items():
        c.names(where, cloud.point, [name])
        if name in cloud.point:
            c.column(f"{where}: {name}", cloud.point[name].numpy(), column)


def check_glb(c, entry):
    """Open3D keeps positions, normals and colours of the triangles of a GLB, in glTF's axes, all objects in one."""
    objects = entry["objects"]
    if objects is None or len(objects) != 1 or not objects[0]["faces"] or entry.get("features"):
        return
    where = entry["path"]
    mesh = o3d.io.read_triangle_mesh(str(c.folder / where))
    c.equal(f"{where}: vertices", len(mesh.vertices), objects[0]["vertices"])
    c.equal(f"{where}: triangles", len(mesh.triangles), objects[0]["faces"])
    # Open3D sorts the vertices anew while it merges equal ones: rows do not correspond, positions do.
    found = checks.from_gltf(np.asarray(mesh.vertices), c.expected["up_axis"]).astype(np.float32) + np.float32(0)
    there = set(map(tuple, found.tolist()))
    column = objects[0]["columns"].get("positions", {"rows": [], "values": []})
    missing = [v for v in np.array(column["values"], np.float32).tolist() if tuple(x + 0.0 for x in v) not in there]
    c.equal(f"{where}: missing positions", missing, [])
    if objects[0]["watertight"] is not None:
        c.equal(f"{where}: watertight", mesh.is_watertight(), objects[0]["watertight"])


main()
