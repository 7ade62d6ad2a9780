"""What the readers' checks share: the expectations that the writer recorded, and how to compare with them.

A folder holds files and `expected.json`:

    {"up_axis": "Z", "files": [
      {"path", "format": "ply"|"npz", ...geometry},
      {"path", "format": "glb", "objects": [{"name", ...geometry}], "nodes": [{"name", "object", "stream",
         "time_start", "time_end"}], "seconds"},
      {"path", "format": "exr", "width", "height", "channels": {name: column}}]}

    geometry: vertices, faces, watertight (or null), columns {name: column}
    column:   type, dim, crc32 (of the rows as little-endian f32, -0 counted as 0), rows, values (samples)

Without `expected.json` the counts in `manifest.json` are what is checked.
"""

import json
import sys
import zlib
from pathlib import Path

import numpy as np


class Checks:
    """Collects differences; `finish` prints them and ends the program."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.expected = load_expected(self.folder)
        self.problems = []
        self.done = 0

    def files(self, *formats):
        return [entry for entry in self.expected["files"] if entry["format"] in formats]

    def equal(self, where, found, expected):
        self.done += 1
        if found != expected:
            self.problems.append(f"{where}: found {found!r}, expected {expected!r}")

    def column(self, where, found, column, tolerance=0.0):
        """Compares all rows (by checksum) and names the first sample that differs. Exact by default."""
        self.done += 1
        found = np.asarray(found, dtype=np.float32)
        found = found.reshape(len(found), -1)
        if found.shape[1] != column["dim"]:
            self.problems.append(f"{where}: {found.shape[1]} components, expected {column['dim']}")
            return
        for row, values in zip(column["rows"], column["values"]):
            if row >= len(found):
                self.problems.append(f"{where}: {len(found)} rows, expected more than {row}")
                return
            values = np.asarray(values, dtype=np.float32)
            if not np.allclose(found[row], values, rtol=0.0, atol=tolerance):
                self.problems.append(f"{where}: row {row} is {found[row].tolist()}, expected {values.tolist()}")
                return
        if tolerance == 0.0 and crc32(found) != column["crc32"]:
            self.problems.append(f"{where}: the samples agree but other rows differ (checksum)")

    def names(self, where, found, expected):
        """Every expected name is there; readers may add their own."""
        missing = sorted(set(expected) - set(found))
        self.equal(f"{where}: missing names", missing, [])

    def finish(self, reader):
        if self.done == 0:
            self.problems.append("nothing was checked: the folder has no file that this reader opens")
        for problem in self.problems:
            print(f"{reader}: {problem}", file=sys.stderr)
        print(f"{reader}: {self.done} checks, {len(self.problems)} differences")
        sys.stdout.flush()
        sys.exit(1 if self.problems else 0)


def crc32(rows):
    # Adding 0 turns -0 into 0: turning axes may flip the sign of a zero.
    return zlib.crc32((rows.astype("<f4") + np.float32(0.0)).tobytes())


def load_expected(folder):
    path = folder / "expected.json"
    if path.exists():
        return json.loads(path.read_text())
    manifest = json.loads((folder / "manifest.json").read_text())
    files = []
    for entry in manifest["files"]:
        file_format = Path(entry["path"]).suffix.lstrip(".")
        if file_format not in ("ply", "npz", "glb"):
            continue
        geometry = {"vertices": entry["vertices"], "faces": entry["faces"], "watertight": None, "columns": {}}
        files.append({"path": entry["path"], "format": file_format, "objects": None, "nodes": [], **geometry})
    return {"up_axis": manifest["up_axis"], "files": files}


def is_watertight(triangles):
    """Every directed edge has its opposite exactly once: closed, manifold, consistently oriented."""
    triangles = np.asarray(triangles, dtype=np.int64)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    keys = edges[:, 0] << 32 | edges[:, 1]
    opposite = edges[:, 1] << 32 | edges[:, 0]
    return len(keys) > 0 and len(np.unique(keys)) == len(keys) and bool(np.isin(opposite, keys).all())


def to_gltf(points, up_axis):
    """World axes to glTF's."""
    points = np.asarray(points)
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1) if up_axis == "Z" else points


def from_gltf(points, up_axis):
    """glTF's axes to the world's."""
    points = np.asarray(points)
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1) if up_axis == "Z" else points


def linear_from_srgb(color):
    """sRGB 0..1 to linear 0..1 (IEC 61966-2-1)."""
    color = np.asarray(color, dtype=np.float64)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def srgb_samples_as_linear(column):
    """The colour column in linear 0..1, for readers that do not convert."""
    values = [linear_from_srgb(np.array(v) / 255.0).tolist() for v in column["values"]]
    return {**column, "values": values}


def scalar_columns(columns):
    """Attributes and features, without what every geometry has."""
    return {name: c for name, c in columns.items() if name not in ("positions", "normals", "colors", "triangles")}


def folder_argument():
    if len(sys.argv) != 2:
        sys.exit(f"usage: {sys.argv[0]} FOLDER")
    return sys.argv[1]
