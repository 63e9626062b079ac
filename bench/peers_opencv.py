"""OpenCV: `remap` with all threads, and loops over pictures."""

import cv2
import numpy as np

use_threads = cv2.setNumThreads


def sample(field, points):
    """`remap` of each picture at its points, laid out as a picture: it takes no longer rows."""
    places = points.reshape(len(points), *field.shape[1:3], 2)  # as many points as pixels
    pictures = [_remap(f, p) for f, p in zip(field, places, strict=True)]
    return np.stack(pictures).reshape(*points.shape[:2], -1)


def _remap(field, places):
    return cv2.remap(field, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def blend(images, weights):
    """A weighted picture added at a time."""
    out = np.zeros((len(weights), *images.shape[1:]), np.float32)
    for row, shares in zip(out, weights, strict=True):
        for image, w in zip(images, shares, strict=True):
            cv2.scaleAdd(image, float(w), row, row)
    return out


def piecewise_warp(field, vertices, triangles, index, barycentric):
    """NumPy finds where the pixels are, `remap` reads them."""
    places = np.einsum("pj,bpjc->bpc", barycentric, vertices[:, triangles[index]])
    return np.stack([_remap(f, p[None])[0] for f, p in zip(field, places, strict=True)])
