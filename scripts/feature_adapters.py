"""The models that extract_features.py knows by name. Each function takes the path of the weights and the device.

Nothing is downloaded: packages and weights must be there. They are imported when used, so that each model's
packages are needed for that model alone. Write your own in the same form and name it `file.py:function`.
"""
import json
import os
import sys

import numpy as np

# Crops that an encoder sees together.
BATCH = 32


def batches(items, run):
    found = [run(items[n:n + BATCH]) for n in range(0, len(items), BATCH)]
    return np.concatenate(found)


def sam(weights, device):
    """Segment Anything (package segment_anything), 32 x 32 prompts."""
    from segment_anything import SamAutomaticMaskGenerator, sam_model_registry
    kind = next((k for k in ("vit_h", "vit_l", "vit_b") if k in os.path.basename(weights)), "vit_h")
    generator = SamAutomaticMaskGenerator(
        sam_model_registry[kind](checkpoint=weights).to(device), points_per_side=32, pred_iou_thresh=0.7,
        stability_score_thresh=0.85, box_nms_thresh=0.7)
    keys = ("segmentation", "predicted_iou", "stability_score")
    return lambda image: [tuple(m[k] for k in keys) for m in generator.generate(image)]


def openclip(weights, device, name="ViT-B-16"):
    """OpenCLIP's image tower (package open_clip_torch)."""
    import open_clip
    import torch
    from PIL import Image
    model, _, prepare = open_clip.create_model_and_transforms(name, pretrained=weights, device=device)
    model.eval()

    @torch.no_grad()
    def run(crops):
        pixels = torch.stack([prepare(Image.fromarray(c)) for c in crops]).to(device)
        return model.encode_image(pixels).float().cpu().numpy()
    return lambda crops: batches(crops, run)


def egovideo(weights, device):
    """EgoVideo's video tower; EGOVIDEO names the folder `backbone` of its repository."""
    import torch
    home = os.environ.get("EGOVIDEO")
    if not home:
        sys.exit("egovideo: set EGOVIDEO to the folder `backbone` of EgoVideo's repository")
    sys.path.insert(0, home)
    from model.setup_model import build_model
    model, _ = build_model(ckpt_path=weights, num_frames=4)
    model = model.eval().to(device).half()
    mean = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1, 1)
    deviation = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1, 1)

    @torch.no_grad()
    def run(clips):
        pixels = []
        for clip in clips:
            frames = torch.from_numpy(np.array(clip)).permute(3, 0, 1, 2).float() / 255
            frames = torch.nn.functional.interpolate(frames.transpose(0, 1), (224, 224), mode="bilinear",
                                                     antialias=True).transpose(0, 1)
            pixels.append((frames - mean) / deviation)
        return model.encode_image(torch.stack(pixels).to(device).half()).float().cpu().numpy()
    return lambda clips: batches(clips, run)


def boxes(weights, device):
    """A hand-object detector's boxes: a JSON file {stem: [[x0, y0, x1, y1], ...]}, px of the frames."""
    found = json.load(open(weights))
    return lambda image, stem: found.get(stem, [])


def dino(weights, device, name="vit_small_patch8_224"):
    """DINO's last patch tokens (package timm)."""
    import timm
    import torch
    model = timm.create_model(name, pretrained=False, num_classes=0, dynamic_img_size=True)
    state = torch.load(weights, map_location="cpu", weights_only=True)
    model.load_state_dict(state.get("teacher", state), strict=False)
    model = model.eval().to(device)
    side = model.patch_embed.patch_size[0]
    mean = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
    deviation = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)

    @torch.no_grad()
    def run(image):
        rows, cols = max(image.shape[0] // side, 1), max(image.shape[1] // side, 1)
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255
        size = (rows * side, cols * side)
        pixels = torch.nn.functional.interpolate(pixels[None], size, mode="bilinear", antialias=True)
        tokens = model.forward_features(((pixels[0] - mean) / deviation)[None].to(device))
        return tokens[0, model.num_prefix_tokens:].reshape(rows, cols, -1).float().cpu().numpy()
    return run
