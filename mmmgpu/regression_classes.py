"""Regression classes: which phones are moved by one common transform in adaptation.

Seconds of video do not hold all phones. Phones of one class share a transform, so that one that
was never heard moves with its class. Classes are tuples of labels: they mean the same for both
streams and are plain to store and to show.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 5.2.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.phones import SIL, VOWELS, ce05_class

Classes = tuple[tuple[str, ...], ...]


def broad_classes(labels: Iterable[str]) -> Classes:
    """Group `labels` into silence, vowels and consonants; empty classes are left out."""
    return _grouped({p: (p == SIL) + 2 * (p in VOWELS) for p in labels})


def paper_classes(labels: Iterable[str]) -> Classes:
    """Group `labels` by the nine classes of CE05, in its order; empty classes are left out.

    Any label goes: diphthongs follow their nucleus, what CE05 lacks its nearest phone; see
    `mmmgpu.phones.ce05_class`.
    """
    return _grouped({label: ce05_class(label) for label in labels})


def kmeans_classes(*streams: PhonemeModels, count: int = 9, seed: int = 0) -> Classes:
    """Group the phones by k-means on their means, each dimension over its `typical_variance`.

    Args:
        streams: Models of the same phones; their dimensions are taken together.
        count: How many classes; no more than there are different means.
        seed: Of k-means.

    Raises:
        InputError: No stream, streams of different phones, or `count` is below 1.
    """
    from sklearn.cluster import KMeans

    if not streams or any(models.labels != streams[0].labels for models in streams):
        raise InputError("streams: give one or more phoneme models, all of the same phones")
    if count < 1:
        raise InputError(f"count: must be at least 1 class, got {count}; the paper has 9")
    points = np.hstack([models.mean / np.sqrt(models.typical_variance) for models in streams])
    count = min(count, len(np.unique(points, axis=0)))
    found = KMeans(count, n_init=10, random_state=seed).fit_predict(points)
    first = {g: int(np.flatnonzero(found == g)[0]) for g in found}  # names do not hang on the seed
    return _grouped({p: first[g] for p, g in zip(streams[0].labels, found, strict=True)})


def _grouped(group_of: dict[str, int]) -> Classes:
    groups = sorted(set(group_of.values()))
    return tuple(tuple(sorted(p for p in group_of if group_of[p] == g)) for g in groups)


def class_rows(models: PhonemeModels, classes: Classes) -> NDArray[np.int64]:
    """Number of the class of each phone of `models`, shape (P,).

    Raises:
        InputError: A phone of `models` is in no class, or in several.
    """
    for label in models.labels:
        times = sum(members.count(label) for members in classes)
        if times != 1:
            raise InputError(
                f"classes: phone {label!r} of the model is in {times} regression classes; "
                "put every phone in exactly one"
            )
    row = {label: g for g, members in enumerate(classes) for label in members}
    return np.array([row[label] for label in models.labels], dtype=np.int64)
