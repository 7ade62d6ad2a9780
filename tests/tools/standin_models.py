"""Tiny stand-ins for the models of extract_features.py: no weights, but features that follow the pixels.

Each model fails when it is called more often than STANDIN_CALLS says, as if the machine went down.
"""
import os

import numpy as np

DIM = 16


def limited(function):
    calls, most = [0], int(os.environ.get("STANDIN_CALLS", 10**9))

    def call(*arguments):
        calls[0] += 1
        if calls[0] > most:
            raise RuntimeError("the stand-in was told to fail here")
        return function(*arguments)
    return call


def descriptor(pixels):
    """Mean colours of the four quarters and their spread, through a fixed random matrix."""
    pixels = np.asarray(pixels, np.float64).reshape(-1, *np.shape(pixels)[-3:]) / 255
    h, w = pixels.shape[1:3]
    quarters = [pixels[:, :h // 2 + 1, :w // 2 + 1], pixels[:, h // 2:, :w // 2 + 1],
                pixels[:, :h // 2 + 1, w // 2:], pixels[:, h // 2:, w // 2:]]
    numbers = np.concatenate([q.mean((0, 1, 2)) for q in quarters] + [pixels.std((0, 1, 2)), [1.0]])
    return np.random.default_rng(0).standard_normal((DIM, numbers.size)) @ numbers


def segmenter(weights, device):
    """Three vertical bands, a near duplicate, one of low quality and an empty one."""
    def masks(image):
        h, w = image.shape[:2]
        bands = [np.zeros((h, w), bool) for _ in range(3)]
        for n, band in enumerate(bands):
            band[:, n * w // 3:(n + 1) * w // 3] = True
        again = bands[0].copy()
        again[0, 0] = False
        return ([(b, 0.9, 0.95) for b in bands] + [(again, 0.8, 0.9), (bands[1].copy(), 0.5, 0.95),
                (np.zeros((h, w), bool), 0.99, 0.99)])
    return limited(masks)


def image(weights, device):
    return limited(lambda crops: np.stack([descriptor(c) for c in crops]))


def too_few(weights, device):
    """A model that loses a crop."""
    return lambda crops: np.stack([descriptor(c) for c in crops])[1:]


def video(weights, device):
    return limited(lambda clips: np.stack([descriptor(c) for c in clips]))


def hands(weights, device):
    """One box that leaves the image."""
    return limited(lambda image, stem: [(-5, image.shape[0] / 2, image.shape[1] / 2, image.shape[0] + 9)])


def parts(weights, device):
    def cells(image):
        return np.stack([[descriptor(image[y:y + 4, x:x + 4])[:6] for x in range(0, image.shape[1] - 3, 4)]
                         for y in range(0, image.shape[0] - 3, 4)])
    return limited(cells)
