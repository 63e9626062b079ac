"""The reference of a corpus: where the mouth is, and the head that every clip is registered to."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.regions import (
    Region,
    carried_mouth,
    locate_mouth,
    refine_centre,
    region_around,
    region_from_box,
    shrink,
    speech_motion,
    width_from_eyes,
)
from mmmgpu.registration import (
    MINIMUM_CORRELATION,
    Head,
    head_from_frame,
    project,
    register,
    to_gray,
)
from mmmgpu.sounds import energy, read_sound
from mmmgpu.tracks import Reference, Track, frame_at, make_reference
from mmmgpu.videos import read_frames

Floats = NDArray[np.float64]

SEARCH_CLIPS = 6  # clips in which the mouth is looked for
SEARCH_FRAMES = 150  # frames of each
CHIN_PULL = 0.12  # mouth widths by which the chin's motion draws the first guess down
EYES_TRUST = 0.87  # of the width that the eyes suggest, the mouth is at least so much
GLANCE_FRAMES = 5  # frames that tell whether a clip shows the head of another
REFINED_WIDTH = 32  # [px] width of the mouth in the stabilised pictures of the second look


def find_reference(
    corpus: Sequence[Clip], box: tuple[int, int, int, int] | None, *, sync: float = 0.0
) -> Reference:
    """A provisional reference: the first frame of a clip and the mouth found around it.

    It is the middle clip, unless its head is not found again in most clips of a sample: then the
    next one of the sample, and so on.

    box: the region (x, y, width, height) [px] in the middle clip, where a person gave it.

    Raises:
        InputError: Nothing moves with the sound, or there is no sound; `box` leaves the frame.
    """
    middle = corpus[len(corpus) // 2]
    if box is not None:
        region = region_from_box(box, (middle.info.width, middle.info.height))
        frame = frame_at(middle.path, 0)
        return make_reference(frame, head_from_frame(frame, np.array(region.mouth)), region)
    sample = [corpus[i] for i in _spread(len(corpus), SEARCH_CLIPS)]
    references = []
    for clip in [middle, *(other for other in sample if other is not middle)]:
        reference, seen = _reference_from(clip, sample, sync)
        if 2 * seen > len(sample):
            return reference
        references.append(reference)
    return references[0]


def _reference_from(clip: Clip, sample: Sequence[Clip], sync: float) -> tuple[Reference, int]:
    """A reference from `clip`, and in how many clips of `sample` its head is found."""
    frame = frame_at(clip.path, 0)
    x, y, width = _find_mouth(sample, sync)
    seen_wide = width_from_eyes(to_gray(frame), (x, y - CHIN_PULL * width, width))
    mouth = (x, y, max(width, EYES_TRUST * seen_wide))
    head = head_from_frame(frame, np.array(mouth))
    seen = [other for other in sample if _shows(other, head)]
    x, y = _second_look(seen or sample, head, np.array(mouth), sync)
    region = region_around((x, y, mouth[2]), (clip.info.width, clip.info.height))
    head = head_from_frame(frame, np.array(region.mouth))
    return make_reference(frame, head, region), len(seen)


def _shows(clip: Clip, head: Head) -> bool:
    """Whether `head` is found in the first frames of `clip`."""
    frames = islice(read_frames(clip.path), GLANCE_FRAMES)
    return all(score >= MINIMUM_CORRELATION for _, score in register(frames, head))


def _find_mouth(sample: Sequence[Clip], sync: float) -> tuple[float, float, float]:
    """(x, y, width) [px] of the mouth in the raw pictures of all clips together."""
    total, scale = np.zeros(0, np.float32), 1.0
    for clip in sample:
        small, scale = shrink(islice(read_frames(clip.path), SEARCH_FRAMES))
        motion = speech_motion(small, loudness(clip, len(small), sync))
        total = motion if not total.size else total + _fit(motion, total.shape)
    x, y, width = (value / scale for value in locate_mouth(total))
    return x, y, width


def _spread(n: int, most: int) -> list[int]:
    """At most `most` of n numbers, evenly spread."""
    return sorted({round(i * (n - 1) / max(1, most - 1)) for i in range(most)})


def _fit(motion: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    resized = cv2.resize(motion, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.float32)


def loudness(clip: Clip, frames: int, sync: float) -> Floats:
    """RMS of the sound in each of the first `frames` frames, moved by `sync` [s]; (frames,)."""
    samples, rate = read_sound(clip.path)
    late = round(sync * rate)
    moved = np.pad(samples, (late, 0)) if late > 0 else samples[-late:]
    return energy(moved, rate, frames, float(clip.info.fps))


def _second_look(
    clips: Sequence[Clip], head: Head, mouth: Floats, sync: float
) -> tuple[float, float]:
    """The centre of the mouth [px], looked for around `mouth` in pictures without head motion."""
    x, y, width = mouth
    unit = width / REFINED_WIDTH
    side = 4 * REFINED_WIDTH
    to_frame = np.array([[unit, 0, x - 2 * width], [0, unit, y - 2 * width], [0, 0, 1]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    total, seen = np.zeros((side, side), np.float32), np.ones((side, side), np.float32)
    for clip in clips:
        pictures = []
        frames = list(islice(read_frames(clip.path), SEARCH_FRAMES))
        for frame, (pose, _) in zip(frames, register(frames, head), strict=True):
            gray = to_gray(frame)
            matrix = pose @ to_frame
            seen_now = cv2.warpPerspective(gray, matrix, (side, side), flags=flags)
            pictures.append(np.asarray(seen_now, np.uint8))
            inside = cv2.warpPerspective(np.ones_like(gray), matrix, (side, side), flags=flags)
            seen = np.minimum(seen, inside)
        total += speech_motion(pictures, loudness(clip, len(pictures), sync))
    total *= cv2.erode(seen, np.ones((9, 9)))  # the edge of the picture moves with the head
    u, v = refine_centre(total, REFINED_WIDTH)
    carried = project(to_frame, np.array([[u, v]]))[0]
    return float(carried[0]), float(carried[1])


def rebase_reference(
    reference: Reference, track: Track, t: int, size: tuple[int, int], *, keep_box: bool
) -> Reference:
    """`reference` in the pixels and colours of frame `t` of `track`: its pose becomes the identity.

    size: (width, height) [px] of the frame. keep_box: move the box as it is, it was given.
    """
    pose, old = track.poses[t], reference.region
    mouth = carried_mouth(old.mouth, partial(project, pose))
    region = region_around(mouth, size)
    if keep_box:
        left = round(min(max(old.box[0] + mouth[0] - old.mouth[0], 0), size[0] - old.box[2]))
        top = round(min(max(old.box[1] + mouth[1] - old.mouth[1], 0), size[1] - old.box[3]))
        region = Region((left, top, *old.box[2:]), (mouth[0], mouth[1], mouth[2]))
    head = replace(reference.head, to_frame=pose @ reference.head.to_frame)
    colours = ((reference.colours - track.offset) / track.gain).astype(np.float32)
    return Reference(head, colours, project(pose, reference.colour_points), region)


def check_sound(corpus: Sequence[Clip]) -> None:
    """Every clip has sound.

    Raises:
        InputError: Of the first clip without.
    """
    for clip in corpus:
        if not clip.info.has_sound:
            raise InputError(
                f"{clip.path}: has no sound, so the mouth cannot be found; "
                "give --region X,Y,W,H or clips with sound"
            )
