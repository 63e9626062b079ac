"""The frames in which two persons are compared: one with the mouth closed, one with it open.

Those of the person with a model come from the model: its reference, and its most open prototype.
Those of the new person come from the clips alone: a quiet frame with the mouth as it mostly is, and
the most open one. A person may choose others (`mark`); `transfer` takes those that POINTS names.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from mmmgpu.alignments import Alignment
from mmmgpu.analysis import byte_thumbnail
from mmmgpu.backends import default_threads
from mmmgpu.basis import Basis
from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.flows import matcher
from mmmgpu.frames import Frames
from mmmgpu.models import Model
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.points import CLOSED, OPEN
from mmmgpu.progress import progress_bar
from mmmgpu.prototypes import most_neutral, principal_coordinates
from mmmgpu.references import check_sound, find_reference, loudness
from mmmgpu.regions import Region, carried_mouth, lip_mask, mouth_mask
from mmmgpu.registration import MINIMUM_CORRELATION, project, register
from mmmgpu.tracks import Reference, crops, frame_at, track_clip
from mmmgpu.videos import probe

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Box = tuple[int, int, int, int]

QUIET = 0.2  # share of the frames that count as quiet: those with the least sound
NONE_GIVEN: Mapping[str, tuple[str, int]] = MappingProxyType({})


@dataclass(frozen=True)
class ShownFrame:
    """A frame to mark points in.

    clip, frame: file name of the clip and number of the frame in it.
    picture: as filmed, (H, W, 3) uint8.
    mouth: (x, y, width) of the mouth in it [px].
    """

    clip: str
    frame: int
    picture: NDArray[np.uint8]
    mouth: tuple[float, float, float]


def openness(flow: F32, region: Region, weight: F32) -> float:
    """How far `flow` parts what is below the mouth's middle from what is above it [px].

    flow: from a closed mouth, (h, w, 2) [px]. weight: (h, w), as `regions.lip_mask`.
    """
    below = np.arange(len(flow)) > region.mouth[1] - region.box[1]
    lower, upper = weight * below[:, None], weight * ~below[:, None]
    down = flow[..., 1]
    return float((lower * down).sum() / lower.sum() - (upper * down).sum() / upper.sum())


def most_open(basis: Basis) -> int:
    """The prototype with the most open mouth."""
    return int(np.argmax([openness(flow, basis.region, basis.w_f) for flow in basis.flows]))


def source_references(model: Model) -> dict[str, ShownFrame]:
    """The frames of the model's person: its reference ("closed") and most open prototype ("open").

    Raises:
        InputError: The head is not found again in the open prototype's frame.
    """
    numbers = {CLOSED: model.basis.reference, OPEN: most_open(model.basis)}
    shown = {}
    for kind, i in numbers.items():
        picture, (clip, frame) = model.prototype_frames[i], model.sources[i]
        pose = pose_of(picture, model.reference, f"prototype {i} ({clip}, frame {frame})")
        shown[kind] = ShownFrame(clip, frame, picture, _carried(model.reference.region, pose))
    return shown


def pose_of(picture: NDArray[np.uint8], reference: Reference, where: str) -> Floats:
    """The pose of one frame, reference pixel -> frame pixel, (3, 3).

    Raises:
        InputError: The reference's head is not found in it; `where` names the frame.
    """
    pose, correlation = next(register([picture], reference.head))
    if correlation < MINIMUM_CORRELATION:
        raise InputError(f"{where}: the head of the reference is not found; choose another frame")
    return pose


def choose_references(
    clips: Sequence[Path],
    *,
    region: Box | None = None,
    sync: float = 0.0,
    given: Mapping[str, tuple[str, int]] = NONE_GIVEN,
) -> dict[str, ShownFrame]:
    """The frames of a new person, "closed" and "open", from the clips alone.

    Args:
        clips: Video files of the person.
        region: (x, y, width, height) [px] of the mouth region in the first frame of the middle
            clip; None finds it from picture and sound.
        sync: [s] by which the sound is moved against the picture; negative: earlier.
        given: Frames (clip name, frame number) that a person has chosen, by kind.

    Raises:
        InputError: A clip cannot be read; the head is found in none; a given frame does not exist.
    """
    corpus = [_silent_clip(path) for path in clips]
    _check_given(corpus, given)
    if region is None:
        check_sound(corpus)
    with one_thread_each():
        reference = find_reference(corpus, region, sync=sync)
        frames = _tracked(corpus, reference)
        numbers = {CLOSED: _most_usual(frames, reference.region, sync)}
        numbers[OPEN] = _most_open_frame(frames, reference.region, numbers[CLOSED])
    places = {kind: frames.find(i) for kind, i in numbers.items()}
    by_name = {clip.name: clip for clip in frames.clips}
    for kind, (name, t) in given.items():
        if name not in by_name:
            raise InputError(f"{name}: the head was not found in this clip; choose another frame")
        places[kind] = (by_name[name], t)
    shown = {}
    for kind, (clip, t) in places.items():
        name = clip.name
        mouth = _carried(reference.region, frames.tracks[name].poses[t])
        shown[kind] = ShownFrame(name, t, frame_at(clip.path, t), mouth)
    return shown


def _check_given(corpus: Sequence[Clip], given: Mapping[str, tuple[str, int]]) -> None:
    frames = {clip.name: clip.length for clip in corpus}
    for kind, (name, t) in given.items():
        if t >= frames.get(name, 0):
            raise InputError(
                f"{name}:{t}: no such frame for the {kind} mouth; the clips are "
                + ", ".join(f"{clip} ({n} frames)" for clip, n in frames.items())
            )


def _silent_clip(path: Path) -> Clip:
    info = probe(path, minimum_frames=2)
    return Clip(path, info, Alignment((), (), info.duration))


def _tracked(corpus: Sequence[Clip], reference: Reference) -> Frames:
    """The clips in which the head is found."""
    tracks, reasons = {}, []
    with progress_bar(len(corpus), "find the head") as advance:
        for clip in corpus:
            try:
                tracks[clip.name] = track_clip(clip.path, reference)
            except InputError as e:
                reasons.append(e)
            advance(1)
    if not tracks:
        raise reasons[0]
    return Frames([clip for clip in corpus if clip.name in tracks], tracks)


def _most_usual(frames: Frames, region: Region, sync: float) -> int:
    """The quiet frame nearest to the median of the quiet ones."""
    mask = mouth_mask(region)
    small, sound = [], []
    for clip in frames.clips:
        images = crops(clip.path, frames.tracks[clip.name], region)
        small.append(np.stack([byte_thumbnail(image, mask) for image in images]))
        count = clip.length
        sound.append(loudness(clip, count, sync) if clip.info.has_sound else np.zeros(count))
    usable, loud = frames.registered, np.concatenate(sound)
    quiet = (loud <= np.quantile(loud[usable], QUIET)) & usable
    numbers = np.flatnonzero(quiet)
    return int(numbers[most_neutral(principal_coordinates(small), numbers, quiet)])


def _most_open_frame(frames: Frames, region: Region, closed: int) -> int:
    match, weight = matcher(), lip_mask(region)
    origin = frames.crops([closed], region)[closed]

    def score(seen: tuple[F32, bool], _: Cancelled) -> float:
        image, usable = seen
        return openness(match(origin, image), region, weight) if usable else -np.inf

    scores: list[float] = []
    for clip in frames.clips:
        track = frames.tracks[clip.name]
        seen = zip(crops(clip.path, track, region), track.registered, strict=True)
        scores += map_ordered(score, seen, threads=default_threads())
    return int(np.argmax(scores))


def _carried(region: Region, pose: Floats) -> tuple[float, float, float]:
    """The mouth (x, y, width) [px] where `pose` sees it."""
    x, y, width = carried_mouth(region.mouth, partial(project, pose))
    return x, y, width
