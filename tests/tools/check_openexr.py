"""OpenEXR reads our EXR files: `check_openexr.py FOLDER`."""

import OpenEXR

import checks


def main():
    c = checks.Checks(checks.folder_argument())
    for entry in c.files("exr"):
        check_exr(c, entry)
    c.finish("OpenEXR")


def check_exr(c, entry):
    where = entry["path"]
    with OpenEXR.File(str(c.folder / where), separate_channels=True) as file:
        c.equal(f"{where}: parts", len(file.parts), 1)
        header = file.header()
        c.equal(f"{where}: compression", header["compression"], OpenEXR.ZIP_COMPRESSION)
        c.equal(f"{where}: storage", header["type"], OpenEXR.scanlineimage)
        c.equal(f"{where}: name", header.get("name", ""), "")
        channels = file.channels()
        c.equal(f"{where}: channels", sorted(channels), sorted(entry["channels"]))
        for name, column in entry["channels"].items():
            if name not in channels:
                continue
            pixels = channels[name].pixels
            c.equal(f"{where}: {name} size", pixels.shape, (entry["height"], entry["width"]))
            c.equal(f"{where}: {name} type", str(pixels.dtype), column["type"])
            c.column(f"{where}: {name}", pixels.reshape(-1, 1), column)


main()
