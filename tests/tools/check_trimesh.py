"""trimesh reads our PLY and GLB files: `check_trimesh.py FOLDER`."""

import numpy as np
import trimesh

import checks


def main():
    c = checks.Checks(checks.folder_argument())
    for entry in c.files("ply"):
        check_ply(c, entry)
    for entry in c.files("glb"):
        check_glb(c, entry)
    c.finish("trimesh")


def check_ply(c, entry):
    where = entry["path"]
    # process=False: trimesh would otherwise merge vertices that share a position.
    loaded = trimesh.load(c.folder / where, process=False)
    c.equal(f"{where}: vertices", len(loaded.vertices), entry["vertices"])
    if entry["faces"]:
        c.equal(f"{where}: faces", len(loaded.faces), entry["faces"])
        if entry["watertight"] is not None:
            c.equal(f"{where}: watertight", bool(loaded.is_watertight), entry["watertight"])
    if "positions" in entry["columns"]:
        c.column(f"{where}: positions", loaded.vertices, entry["columns"]["positions"])
    rows = loaded.metadata["_ply_raw"]["vertex"]["data"]
    prefix = entry.get("prefix", "")
    for name, column in checks.scalar_columns(entry["columns"]).items():
        dims = range(column["dim"])
        names = [f"{prefix}{name}_{d:03}" for d in dims] if column["feature"] else [prefix + name]
        found = [np.asarray(rows[n]).reshape(-1, 1) for n in names if n in rows.dtype.names]
        c.names(where, rows.dtype.names, names)
        if found:
            c.column(f"{where}: {name}", np.concatenate(found, axis=1), column)


def check_glb(c, entry):
    where = entry["path"]
    scene = trimesh.load(c.folder / where, process=False)
    if entry["objects"] is None:
        return
    # Point clouds lose their attributes here: only meshes are looked at.
    for expected in entry["objects"]:
        if not expected["faces"]:
            continue
        name = expected["name"]
        c.names(where, scene.geometry, [name])
        if name in scene.geometry:
            check_mesh(c, f"{where}: {name}", scene.geometry[name], expected, entry)
            check_features(c, f"{where}: {name}", scene.geometry.get(f"{name}_features"), expected, entry)
    for node in entry["nodes"]:
        if node["object"] is not None and node["faces"]:
            c.names(f"{where}: nodes", scene.graph.nodes, [node["name"]])


def check_mesh(c, where, mesh, expected, entry):
    columns = expected["columns"]
    c.equal(f"{where}: vertices", len(mesh.vertices), expected["vertices"])
    c.equal(f"{where}: faces", len(mesh.faces), expected["faces"])
    if expected["watertight"] is not None:
        c.equal(f"{where}: watertight", bool(mesh.is_watertight), expected["watertight"])
    positions = checks.from_gltf(mesh.vertices, c.expected["up_axis"])
    c.column(f"{where}: positions", positions, columns["positions"])
    if "normals" in columns:
        # trimesh makes them unit length once more: a few units in the last place of an f32.
        normals = checks.from_gltf(mesh.vertex_normals, c.expected["up_axis"])
        c.column(f"{where}: normals", normals, columns["normals"], tolerance=1e-6)
    if "colors" in columns and entry.get("float_colors"):
        # trimesh shows the linear values, rounded to bytes: half a step. Of 16-bit colours it keeps the low byte.
        found = mesh.visual.vertex_colors[:, :3] / 255.0
        linear = checks.srgb_samples_as_linear(columns["colors"])
        c.column(f"{where}: colors", found, linear, tolerance=0.501 / 255.0)
    for name, column in checks.scalar_columns(columns).items():
        if column["feature"]:
            continue
        attribute = f"_{name.upper()}"
        c.names(where, mesh.vertex_attributes, [attribute])
        if attribute in mesh.vertex_attributes:
            c.column(f"{where}: {name}", mesh.vertex_attributes[attribute], column)
    c.equal(f"{where}: offset", mesh.metadata.get("offset"), expected["offset"])


def check_features(c, where, mesh, expected, entry):
    features = {name: column for name, column in expected["columns"].items() if column["feature"]}
    if not entry.get("features") or not features:
        return
    c.equal(f"{where}: features mesh is there", mesh is not None, True)
    if mesh is None:
        return
    for name, column in features.items():
        names = [f"_{name.upper()}_{quad:03}" for quad in range((column["dim"] + 3) // 4)]
        c.names(f"{where}_features", mesh.vertex_attributes, names)
        if set(names) <= set(mesh.vertex_attributes):
            quads = np.concatenate([mesh.vertex_attributes[n] for n in names], axis=1)
            c.column(f"{where}_features: {name}", quads[:, : column["dim"]], column)


main()
