#!/usr/bin/env python3
"""Extract the features of a scene's frames: what `divff` needs to answer phrases.

    python extract_features.py SCENE --segmenter sam=sam_vit_h.pth \\
        --image openclip=open_clip_pytorch_model.bin --video egovideo=egovideo.pt --hands boxes=hands.json \\
        --parts dino=dino_vits8.pth

Every model is optional; what is given is extracted, into the scene folder:

  --segmenter + --image   language_features/<stem>_s.npy, _f.npy (masks), _b.npy (their boxes)
  --image                 language_features/<stem>_p0.npy ... (patches; --patch-scales)
  --video                 video_features/<stem>_p.npy (33 % patches, stride one half), _g.npy (the whole clip)
  --hands                 hotspots/<stem>.png (boxes of hands and of what they hold)
  --parts                 dino_features/<stem>.npy

A model is ADAPTER=WEIGHTS. ADAPTER names a function of feature_adapters.py (beside this script), or
`file.py:function` of yours. It is called with the path of the weights and the device and returns a function:

  segmenter(image)  -> list of (mask [H, W] bool, predicted IoU, stability); image: uint8 [H, W, 3]
  image(crops)      -> [n, D]; crops: list of uint8 [h, w, 3]
  video(clips)      -> [n, D]; clips: list of uint8 [4, h, w, 3]
  hands(image, stem)-> list of (x0, y0, x1, y1), px
  parts(image)      -> [rows, cols, C]

Clips are 4 frames, 15 frames of a 60-fps video apart, around the frame. --video-frames names a folder with the
frames of the whole video, numbered as the scene's `frame_index`; without it, the scene's own frames nearest in
number are taken.

Only frames that are trained on are looked at (--split all: all). Files appear complete or not at all; what is
there is kept, so an interrupted run is simply started again. Other settings than those of a folder's meta.json
are refused, unless --force, which writes everything anew. Needs numpy and Pillow, and what the adapters need.
"""
import argparse
import importlib.util
import json
import os
import re
import sys

import numpy as np
from PIL import Image

CLIP_FRAMES, CLIP_STRIDE, CLIP_FPS = 4, 15, 60
VIDEO_PATCH = 0.33
MIN_IOU, MIN_STABILITY, MAX_OVERLAP = 0.7, 0.85, 0.7
HERE = os.path.dirname(os.path.abspath(__file__))


def stop(message):
    sys.exit(f"extract_features.py: {message}")


def warn(message):
    print(f"warning: {message}", file=sys.stderr)


# The scene.

def open_scene(root, split):
    """Frames as dictionaries with path, stem and index, in the file's order."""
    path = f"{root}/transforms.json"
    if not os.path.isfile(path):
        stop(f"{path} does not exist; features are extracted for scenes in nerfstudio's format")
    scene = read_json(path)
    listed = scene.get("frames")
    if not listed or not all("file_path" in f for f in listed):
        stop(f"{path}: no `frames`, or some without `file_path`")
    test = scene.get("test_filenames") or scene.get("val_filenames")
    frames = []
    for n, frame in enumerate(listed):
        name = frame["file_path"]
        numbers = re.findall(r"\d+", os.path.basename(name))
        index = frame.get("frame_index", int(numbers[-1]) if numbers else n)
        held_out = name in test if test else None
        stem = os.path.splitext(os.path.basename(name))[0]
        frames.append(dict(path=f"{root}/{name}", stem=stem, index=index, test=held_out))
    frames.sort(key=lambda f: f["index"])
    for n, frame in enumerate(frames):
        frame["test"] = n % 8 == 4 if frame["test"] is None else frame["test"]
    return frames, [f for f in frames if split == "all" or not f["test"]]


def read_json(path):
    try:
        found = json.load(open(path, encoding="utf-8"))
    except (OSError, ValueError) as error:
        stop(f"{path}: {error}")
    if not isinstance(found, dict):
        stop(f"{path}: not an object in braces")
    return found


def read_image(path):
    try:
        return np.asarray(Image.open(path).convert("RGB"))
    except (OSError, SyntaxError) as error:
        stop(f"{path}: {error}")


# Files: complete or not there.

def atomically(path, write):
    temporary = f"{os.path.dirname(path)}/.{os.path.basename(path)}.{os.getpid()}.tmp"
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        if os.path.exists(temporary):
            os.remove(temporary)


def save(path, array):
    atomically(path, lambda file: np.save(file, np.ascontiguousarray(array)))


def describe(model, items, what):
    """A model's descriptors of items as f16, of unit length; one that is zero or not finite stays and is named."""
    features = np.asarray(model(items), np.float32)
    if features.ndim != 2 or len(features) != len(items) or not features.size:
        stop(f"{what}: the model gave an array {features.shape} for {len(items)} items, not [{len(items)}, D]")
    norm = np.linalg.norm(features, axis=1, keepdims=True)
    bad = ~np.isfinite(features).all(1) | (norm[:, 0] == 0)
    if bad.any():
        warn(f"{what}: {int(bad.sum())} of {bad.size} descriptors are zero or not finite")
    return np.where(norm > 0, features / np.where(norm > 0, norm, 1), features).astype(np.float16)


class Folder:
    """A feature folder with its settings."""

    def __init__(self, root, name, settings, force):
        self.path = f"{root}/{name}"
        self.force = force
        os.makedirs(self.path, exist_ok=True)
        meta = f"{self.path}/meta.json"
        settings = json.loads(json.dumps(settings))
        if os.path.isfile(meta) and not force:
            old = read_json(meta)
            # What was not said, or is not said now, contradicts nothing: masks may come after patches.
            said = {k: v for k, v in settings.items() if v not in ("", [])}
            differing = [k for k in said if old.get(k, "") not in ("", [], said[k])]
            if differing:
                stop(f"{meta} was made with another {', '.join(differing)}; use the same, or --force")
            settings = {**old, **said}
            if settings == old:
                return
        atomically(meta, lambda file: file.write(json.dumps(settings, indent=1).encode()))

    def missing(self, stem, parts, extension="npy"):
        paths = [f"{self.path}/{stem}{part}.{extension}" for part in parts]
        return self.force or not all(os.path.isfile(p) for p in paths)

    def save(self, stem, part, array):
        save(f"{self.path}/{stem}{part}.npy", array)


# Masks.

def choose(found):
    """Good masks without near duplicates, the best first."""
    found = [(np.asarray(m, bool), iou, stability) for m, iou, stability in found]
    good = [f for f in found if f[1] >= MIN_IOU and f[2] >= MIN_STABILITY and f[0].any()]
    kept = []
    for mask, iou, stability in sorted(good, key=lambda f: -f[1] * f[2]):
        overlap = (np.logical_and(mask, k).sum() / np.logical_or(mask, k).sum() for k in kept)
        if all(o <= MAX_OVERLAP for o in overlap):
            kept.append(mask)
    return kept


def index_map(masks, shape):
    """Number of the smallest mask at each pixel, -1 where there is none: [1, H, W]."""
    index = np.full(shape, -1, np.int32)
    for n in sorted(range(len(masks)), key=lambda n: -masks[n].sum()):
        index[masks[n]] = n
    return index[None]


def box_of(mask):
    ys, xs = np.nonzero(mask)
    return xs.min(), ys.min(), xs.max() + 1, ys.max() + 1


def square(crop):
    """Padded with black to a square, as the encoder's input is one."""
    size = max(crop.shape[:2])
    out = np.zeros((size, size, 3), np.uint8)
    y, x = (size - crop.shape[0]) // 2, (size - crop.shape[1]) // 2
    out[y:y + crop.shape[0], x:x + crop.shape[1]] = crop
    return out


def language(image, stem, models, folder):
    if not folder.missing(stem, ["_s", "_f", "_b"]):
        return
    masks = choose(models["segmenter"](image))
    # A mask that others hide has no pixel to teach: it is left out.
    seen = np.unique(index_map(masks, image.shape[:2]))
    masks = [masks[n] for n in seen if n >= 0]
    if not masks:
        warn(f"{stem}: no masks")
        return
    alone, boxed = [], []
    for mask in masks:
        x0, y0, x1, y1 = box_of(mask)
        alone.append(square(np.where(mask[..., None], image, 0)[y0:y1, x0:x1]))
        boxed.append(square(image[y0:y1, x0:x1]))
    folder.save(stem, "_b", describe(models["image"], boxed, f"{stem}, boxes"))
    folder.save(stem, "_f", describe(models["image"], alone, f"{stem}, masks"))
    folder.save(stem, "_s", index_map(masks, image.shape[:2]))


# Patches.

def grid(size, stride, image_size):
    """Left upper corners along each axis, at whole pixels."""
    def along(n):
        count = int((image_size[n] - size[n]) // stride[n]) + 1
        return [int(k * stride[n]) for k in range(max(count, 1))]
    return along(0), along(1)


def patch_layout(fraction, image_size, square_patches):
    """Size and stride (one half) of patches, px, [x, y]."""
    if square_patches:
        side = min(max(int(round(fraction * image_size[1])), 1), *image_size)
        return [side, side], [side / 2, side / 2]
    size = [max(int(round(fraction * s)), 1) for s in image_size]
    return size, [s / 2 for s in size]


def layout_of(part, fraction, image_size, square_patches):
    size, stride = patch_layout(fraction, image_size, square_patches)
    xs, ys = grid(size, stride, image_size)
    return dict(file=part, fraction=fraction, size_px=size, stride_px=stride, origin_px=[0, 0], rows=len(ys),
                cols=len(xs))


def crops(pixels, layout):
    """Patches of `[..., H, W, 3]`, row by row."""
    size, stride = layout["size_px"], layout["stride_px"]
    xs, ys = grid(size, stride, (pixels.shape[-2], pixels.shape[-3]))
    return [pixels[..., y:y + size[1], x:x + size[0], :] for y in ys for x in xs]


def patches(image, stem, models, folder, layouts):
    for layout in layouts:
        part = "_" + layout["file"]
        if folder.missing(stem, [part]):
            found = describe(models["image"], crops(image, layout), f"{stem}, patches {part}")
            folder.save(stem, part, found.reshape(layout["rows"], layout["cols"], -1))


# Video.

class Clips:
    """The 4 frames around a frame."""

    def __init__(self, frames, folder, fps):
        self.step = CLIP_STRIDE * fps / CLIP_FPS
        self.paths = {f["index"]: f["path"] for f in frames}
        if folder:
            names = [n for n in sorted(os.listdir(folder)) if re.search(r"\d+\.(jpe?g|png)$", n, re.I)]
            self.paths = {int(re.findall(r"\d+", n)[-1]): f"{folder}/{n}" for n in names}
            if not self.paths:
                stop(f"{folder}: no numbered frames in it")
        self.indices = np.array(sorted(self.paths))

    def around(self, index):
        wanted = [index + (k - (CLIP_FRAMES - 1) / 2) * self.step for k in range(CLIP_FRAMES)]
        nearest = [int(self.indices[np.abs(self.indices - w).argmin()]) for w in wanted]
        images = [read_image(self.paths[n]) for n in nearest]
        if any(i.shape != images[0].shape for i in images):
            stop(f"the frames {nearest} of the video have different sizes")
        return np.stack(images)


def video(frame, models, folder, clips, layout):
    stem = frame["stem"]
    if not folder.missing(stem, ["_p", "_g"]):
        return
    clip = clips.around(frame["index"])
    # A video at another resolution is cut at the same places of the picture.
    scale = [clip.shape[2] / layout["image_size"][0], clip.shape[1] / layout["image_size"][1]]
    if scale != [1, 1]:
        size = tuple(layout["image_size"])
        clip = np.stack([np.asarray(Image.fromarray(f).resize(size, Image.BILINEAR)) for f in clip])
    found = describe(models["video"], crops(clip, layout), f"{stem}, video patches")
    folder.save(stem, "_p", found.reshape(layout["rows"], layout["cols"], -1))
    folder.save(stem, "_g", describe(models["video"], [clip], f"{stem}, clip")[0])


# Hotspots and parts.

def hotspot(image, stem, models, folder):
    if not folder.missing(stem, [""], "png"):
        return
    height, width = image.shape[:2]
    inside = np.zeros((height, width), np.uint8)
    for x0, y0, x1, y1 in models["hands"](image, stem):
        x0, y0, x1, y1 = (int(round(float(v))) for v in (x0, y0, x1, y1))
        inside[max(y0, 0):max(y1, 0), max(x0, 0):max(x1, 0)] = 255
    atomically(f"{folder.path}/{stem}.png", lambda file: Image.fromarray(inside).save(file, "PNG"))


def parts(image, stem, models, folder):
    if folder.missing(stem, [""]):
        found = np.asarray(models["parts"](image), np.float32)
        if found.ndim != 3 or 0 in found.shape:
            stop(f"{stem}: the parts' features have the shape {found.shape}, not [rows, cols, C]")
        folder.save(stem, "", found.astype(np.float16))


# Models.

def load(kind, text, device):
    """The function that `ADAPTER=WEIGHTS` describes."""
    adapter, separator, weights = text.partition("=")
    if not separator:
        stop(f"--{kind} {text}: write ADAPTER=WEIGHTS, such as sam=sam_vit_h.pth")
    built_in = f"{HERE}/feature_adapters.py"
    path, _, function = adapter.rpartition(":") if ":" in adapter else (built_in, "", adapter)
    if not os.path.isfile(path):
        stop(f"--{kind} {text}: {path} does not exist")
    spec = importlib.util.spec_from_file_location(f"adapter_{kind}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, function):
        stop(f"--{kind} {text}: {path} has no function {function}")
    return getattr(module, function)(weights, device)


def settings_of(args, image_size):
    """What meta.json of each folder says."""
    name = lambda kind: os.path.basename(getattr(args, kind) or "")  # noqa: E731
    try:
        scales = sorted(float(s) for s in args.patch_scales.split(",") if s)
    except ValueError:
        stop(f"--patch-scales {args.patch_scales}: write fractions of the height such as 0.15,0.33")
    if not all(0 < s <= 1 for s in scales):
        stop(f"--patch-scales {args.patch_scales}: fractions of the height are above 0 and at most 1")
    pyramid = [layout_of(f"p{n}", s, image_size, True) for n, s in enumerate(scales)]
    local = dict(layout_of("p", VIDEO_PATCH, image_size, False), image_size=image_size)
    common = dict(image_size=image_size, dtype="float16")
    return pyramid, local, dict(
        language_features=dict(common, model=name("image"), segmenter=name("segmenter"), patches=pyramid,
                               filter=dict(iou=MIN_IOU, stability=MIN_STABILITY, overlap=MAX_OVERLAP)),
        video_features=dict(common, model=name("video"), patches=local,
                            clip=dict(frames=CLIP_FRAMES, stride=CLIP_STRIDE, fps=CLIP_FPS)),
        hotspots=dict(model=name("hands")),
        dino_features=dict(common, model=name("parts")))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    for kind in ("segmenter", "image", "video", "hands", "parts"):
        parser.add_argument(f"--{kind}", metavar="ADAPTER=WEIGHTS")
    parser.add_argument("--patch-scales", default="0.15,0.33,0.5", help="heights of patches; empty: no patches")
    parser.add_argument("--video-frames", help="folder with the frames of the whole video")
    parser.add_argument("--video-fps", type=float, default=CLIP_FPS, help="frames a second that the numbers count")
    parser.add_argument("--split", choices=["train", "all"], default="train")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--force", action="store_true", help="write everything anew")
    args = parser.parse_args()
    if args.segmenter and not args.image:
        stop("--segmenter finds masks; --image is needed to describe them")
    every, frames = open_scene(args.scene, args.split)
    if not frames:
        stop(f"{args.scene}: no frames to look at")
    image_size = list(read_image(frames[0]["path"]).shape[1::-1])
    pyramid, local, settings = settings_of(args, image_size)
    kinds = [k for k in ("segmenter", "image", "video", "hands", "parts") if getattr(args, k)]
    if not kinds:
        stop("no model given; see --help")
    folder_of = dict(image="language_features", video="video_features", hands="hotspots", parts="dino_features")
    # Folders last: settings are written down once every model is there.
    models = {k: load(k, getattr(args, k), args.device) for k in kinds}
    folders = {k: Folder(args.scene, name, settings[name], args.force) for k, name in folder_of.items() if k in kinds}
    clips = Clips(every, args.video_frames, args.video_fps) if "video" in models else None
    for n, frame in enumerate(frames):
        image, stem = read_image(frame["path"]), frame["stem"]
        if list(image.shape[1::-1]) != image_size:
            stop(f"{frame['path']} has {image.shape[1::-1]} pixels, the first frame {image_size}")
        if "segmenter" in models:
            language(image, stem, models, folders["image"])
        if "image" in models:
            patches(image, stem, models, folders["image"], pyramid)
        if "video" in models:
            video(frame, models, folders["video"], clips, local)
        if "hands" in models:
            hotspot(image, stem, models, folders["hands"])
        if "parts" in models:
            parts(image, stem, models, folders["parts"])
        print(f"{n + 1}/{len(frames)} {stem}", flush=True)


if __name__ == "__main__":
    main()
