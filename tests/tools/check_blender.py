"""Blender (the `bpy` module) imports our GLB and PLY files: `check_blender.py FOLDER`.

Run it under several PYTHONHASHSEED: Blender 5.0's importer walks custom attributes in hash order.
"""

import bpy
import numpy as np

import checks


def main():
    c = checks.Checks(checks.folder_argument())
    for entry in c.files("glb"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.gltf(filepath=str(c.folder / entry["path"]))
        check_glb(c, entry)
    for entry in c.files("ply"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        # No conversion: the file is in world axes.
        bpy.ops.wm.ply_import(filepath=str(c.folder / entry["path"]), forward_axis="Y", up_axis="Z")
        check_ply(c, entry)
    c.finish("Blender")


def check_glb(c, entry):
    where = entry["path"]
    if entry["objects"] is None:
        total = sum(len(mesh.vertices) for mesh in bpy.data.meshes)
        c.equal(f"{where}: vertices", total, entry["vertices"])
        return
    for expected in entry["objects"]:
        name = expected["name"]
        c.names(where, bpy.data.meshes.keys(), [name])
        if name in bpy.data.meshes:
            mesh = bpy.data.meshes[name]
            check_mesh(c, f"{where}: {name}", mesh, expected, checks.scalar_columns(expected["columns"]), glb_name)
            c.equal(f"{where}: {name}: offset", list(mesh.get("offset", [])), expected["offset"])
            check_features(c, f"{where}: {name}", expected, entry)
    check_nodes(c, where, entry)


def glb_name(name):
    return f"_{name.upper()}"


def check_mesh(c, where, mesh, expected, scalars, attribute_name):
    c.equal(f"{where}: vertices", len(mesh.vertices), expected["vertices"])
    c.equal(f"{where}: faces", len(mesh.polygons), expected["faces"])
    columns = expected["columns"]
    if "positions" in columns:
        # The importer turns glTF's axes into Blender's (Z up); a Y-up world therefore arrives turned.
        positions = vectors(mesh.vertices, "co")
        if c.expected["up_axis"] == "Y" and attribute_name is glb_name:
            positions = checks.to_gltf(positions, "Z")
        c.column(f"{where}: positions", positions, columns["positions"])
    if expected["watertight"] is not None and expected["faces"]:
        triangles = np.array([p.vertices[:] for p in mesh.polygons])
        c.equal(f"{where}: watertight", checks.is_watertight(triangles), expected["watertight"])
    if "colors" in columns and mesh.color_attributes:
        # Linear in memory. One step of u16 is 1.5e-5, one of Blender's byte colours at most 0.0089 when linear.
        attribute = mesh.color_attributes[0]
        values = values_of(attribute, "color", 4)[:, :3]
        if attribute.domain == "CORNER":
            values = corner_to_vertex(mesh, values)
        tolerance = 2e-5 if attribute.data_type == "FLOAT_COLOR" else 0.009
        c.column(f"{where}: colors", values, checks.srgb_samples_as_linear(columns["colors"]), tolerance)
    for name, column in scalars.items():
        names = [attribute_name(name)]
        if column["feature"]:
            if attribute_name is glb_name:
                continue
            names = [attribute_name(f"{name}_{d:03}") for d in range(column["dim"])]
        c.names(where, mesh.attributes.keys(), names)
        if set(names) <= set(mesh.attributes.keys()):
            found = [values_of(mesh.attributes[n], "value", 1) for n in names]
            c.column(f"{where}: {name}", np.concatenate(found, axis=1), column)


def check_features(c, where, expected, entry):
    features = {name: column for name, column in expected["columns"].items() if column["feature"]}
    if not entry.get("features") or not features:
        return
    c.names(where, bpy.data.meshes.keys(), [f"{expected['name']}_features"])
    mesh = bpy.data.meshes.get(f"{expected['name']}_features")
    if mesh is None:
        return
    for name, column in features.items():
        names = [f"_{name.upper()}_{quad:03}" for quad in range((column["dim"] + 3) // 4)]
        c.names(f"{where}_features", mesh.attributes.keys(), names)
        if set(names) <= set(mesh.attributes.keys()):
            quads = [values_of(mesh.attributes[n], "color", 4) for n in names]
            c.column(f"{where}_features: {name}", np.concatenate(quads, axis=1)[:, : column["dim"]], column)


def check_nodes(c, where, entry):
    """Each object is there, with its custom properties, and visible exactly in its interval."""
    scene = bpy.context.scene
    fps = scene.render.fps / scene.render.fps_base
    for node in entry["nodes"]:
        if node["object"] is None:
            continue
        c.names(f"{where}: objects", bpy.data.objects.keys(), [node["name"]])
        thing = bpy.data.objects.get(node["name"])
        if thing is None:
            continue
        c.equal(f"{where}: {node['name']}: mesh", thing.data.name, node["object"])
        c.equal(f"{where}: {node['name']}: stream", thing.get("stream"), node["stream"])
        if node["time_start"] is None:
            continue
        c.equal(f"{where}: {node['name']}: time_start", thing.get("time_start"), node["time_start"])
        c.equal(f"{where}: {node['name']}: time_end", thing.get("time_end"), node["time_end"])
        for other in entry["nodes"]:
            if other["time_start"] is None:
                continue
            middle = 0.5 * (other["time_start"] + other["time_end"])
            scene.frame_set(round(middle * entry["seconds"] * fps))
            visible = node["time_start"] <= middle < node["time_end"]
            scale = [round(s, 6) for s in thing.matrix_world.to_scale()]
            c.equal(f"{where}: {node['name']}: scale at {middle}", scale, [1.0 if visible else 0.0] * 3)


def check_ply(c, entry):
    meshes = list(bpy.data.meshes)
    c.equal(f"{entry['path']}: meshes", len(meshes), 1)
    if meshes:
        scalars = checks.scalar_columns(entry["columns"])
        prefix = entry.get("prefix", "")
        check_mesh(c, entry["path"], meshes[0], entry, scalars, lambda name: prefix + name)


def vectors(collection, key):
    values = np.empty(3 * len(collection), dtype=np.float32)
    collection.foreach_get(key, values)
    return values.reshape(-1, 3)


def values_of(attribute, key, width):
    integer = attribute.data_type in ("INT", "INT8")
    values = np.empty(width * len(attribute.data), dtype=np.int32 if integer else np.float32)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width)


def corner_to_vertex(mesh, values):
    corners = np.empty(len(mesh.loops), dtype=np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    by_vertex = np.zeros((len(mesh.vertices), values.shape[1]), dtype=values.dtype)
    by_vertex[corners] = values
    return by_vertex


main()
