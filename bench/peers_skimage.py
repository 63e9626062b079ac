"""scikit-image: `warp` by given coordinates."""

import importlib

import numpy as np

warp = importlib.import_module("skimage.transform").warp  # not a dependency


def sample(field, points):
    """One channel at a time, which is what it is faster with."""
    height, width = field.shape[1:3]
    places = points.reshape(len(points), height, width, 2)[..., ::-1]  # as many points as pixels

    def one(picture, rows_and_columns):
        given = np.moveaxis(rows_and_columns, -1, 0)
        channels = [warp(c, given, order=1, mode="edge") for c in np.moveaxis(picture, -1, 0)]
        return np.stack(channels, -1)

    pictures = [one(f, p) for f, p in zip(field, places, strict=True)]
    return np.stack(pictures).reshape(*points.shape[:2], -1)
