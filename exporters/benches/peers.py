"""Times other programs' readers and writers for `files.rs`, one job a line on stdin: `JOB FORMAT PATH`.

`load` reads what later `write` jobs write; `write` and `read` are timed. Answers, one line each: seconds and the
file's bytes, or `missing` and what is not installed. OpenEXR decides itself how many threads it takes.
"""

import os
import sys
import time


class Open3d:
    def __init__(self):
        import open3d

        self.io = open3d.t.io

    def read(self, path):
        return self.io.read_point_cloud(path)

    def write(self, path, cloud):
        assert self.io.write_point_cloud(path, cloud)


class Trimesh:
    def __init__(self):
        import trimesh

        self.load = trimesh.load

    def read(self, path):
        (mesh,) = self.load(path, process=False).geometry.values()
        return mesh

    def write(self, path, mesh):
        mesh.export(path)


class OpenExr:
    def __init__(self):
        import OpenEXR

        self.module = OpenEXR

    def read(self, path):
        # Closing the file would empty what it gave.
        file = self.module.File(path, separate_channels=True)
        return file, {name: channel.pixels for name, channel in file.channels().items()}

    def write(self, path, picture):
        header = {"compression": self.module.ZIP_COMPRESSION, "type": self.module.scanlineimage}
        self.module.File(header, picture[1]).write(path)


PEERS = {"ply": Open3d, "glb": Trimesh, "exr": OpenExr}


def main():
    peers, loaded = {}, {}
    for line in sys.stdin:
        job, form, path = line.rstrip("\n").split(" ", 2)
        try:
            peer = peers.setdefault(form, None) or PEERS[form]()
        except ImportError as error:
            print("missing", error, flush=True)
            continue
        peers[form] = peer
        start = time.perf_counter()
        if job == "write":
            peer.write(path, loaded[form])
        else:
            content = peer.read(path)
        seconds = time.perf_counter() - start
        if job == "load":
            loaded[form] = content
        print(seconds, os.path.getsize(path), flush=True)


main()
