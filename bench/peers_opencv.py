"""OpenCV: `remap` with all threads, and loops over pictures."""

import cv2
import numpy as np


def sample(field, points):
    """`remap` of each picture at its points, as a picture of one row as long as OpenCV allows."""
    height, width = field.shape[1:3]
    maps = points.reshape(len(points), height, width, 2)  # as many points as pixels
    x, y = np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])

    def run():
        pictures = [_remap(f, *m) for f, *m in zip(field, x, y, strict=True)]
        return np.stack(pictures).reshape(*points.shape[:2], -1)

    return run


def _remap(field, x, y):
    return cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def blend(images, weights):
    """A weighted picture added at a time."""

    def run():
        out = np.zeros((len(weights), *images.shape[1:]), np.float32)
        for row, shares in zip(out, weights, strict=True):
            for image, w in zip(images, shares, strict=True):
                cv2.scaleAdd(image, float(w), row, row)
        return out

    return run


def piecewise_warp(field, vertices, triangles, index, barycentric):
    """NumPy finds where the pixels are, `remap` reads them."""
    corners = triangles[index]

    def run():
        places = np.einsum("pj,bpjc->bpc", barycentric, vertices[:, corners])
        x, y = (np.ascontiguousarray(places[:, None, :, i]) for i in (0, 1))
        return np.stack([_remap(f, *m)[0] for f, *m in zip(field, x, y, strict=True)])

    return run
