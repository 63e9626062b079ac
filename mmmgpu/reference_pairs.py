"""The frames in which two persons are compared: one with the mouth closed, one with it open.

Those of the person with a model come from the model: its reference, and its most open prototype.
Those of the new person come from the clips alone: a quiet frame with the mouth as it mostly is, and
the most open one. A person may choose others (`mark`); `transfer` takes those that POINTS names.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from mmmgpu.alignments import Alignment
from mmmgpu.analysis import thumbnail
from mmmgpu.basis import Basis
from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.flows import matcher
from mmmgpu.models import Model
from mmmgpu.parallel import one_thread_each
from mmmgpu.progress import progress_bar
from mmmgpu.prototypes import principal_coordinates
from mmmgpu.references import check_sound, find_reference
from mmmgpu.regions import Region, lip_mask, mouth_mask
from mmmgpu.registration import MINIMUM_CORRELATION, project, register
from mmmgpu.sounds import energy, read_sound
from mmmgpu.tracks import Reference, Track, crops, frame_at, track_clip
from mmmgpu.videos import probe

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Box = tuple[int, int, int, int]

QUIET = 0.2  # share of the frames that count as quiet: those with the least sound
CLOSED, OPEN = "closed", "open"
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
        tracks = _tracks(corpus, reference)
        corpus = [clip for clip in corpus if clip.path.name in tracks]
        mask = mouth_mask(reference.region)
        small = [
            np.stack([_bytes(thumbnail(image, mask)) for image in _crops(clip, tracks, reference)])
            for clip in corpus
        ]
        usable = np.concatenate([tracks[clip.path.name].registered for clip in corpus])
        quiet = np.concatenate([_loudness(clip, sync) for clip in corpus])
        quiet = quiet <= np.quantile(quiet[usable], QUIET)
        closed = _most_usual(principal_coordinates(small), quiet & usable)
        opened = _most_open_frame(corpus, tracks, reference, closed)
    by_name = {clip.path.name: clip for clip in corpus}
    places = {CLOSED: _place(corpus, closed), OPEN: _place(corpus, opened)}
    for kind, (name, t) in given.items():
        if name not in by_name:
            raise InputError(f"{name}: the head was not found in this clip; choose another frame")
        places[kind] = (by_name[name], t)
    return {
        kind: ShownFrame(
            clip.path.name,
            t,
            frame_at(clip.path, t),
            _carried(reference.region, tracks[clip.path.name].poses[t]),
        )
        for kind, (clip, t) in places.items()
    }


def _check_given(corpus: Sequence[Clip], given: Mapping[str, tuple[str, int]]) -> None:
    frames = {clip.path.name: clip.info.frames for clip in corpus}
    for kind, (name, t) in given.items():
        if t >= frames.get(name, 0):
            raise InputError(
                f"{name}:{t}: no such frame for the {kind} mouth; the clips are "
                + ", ".join(f"{clip} ({n} frames)" for clip, n in frames.items())
            )


def _silent_clip(path: Path) -> Clip:
    info = probe(path, minimum_frames=2)
    return Clip(path, info, Alignment((), (), info.duration))


def _tracks(corpus: Sequence[Clip], reference: Reference) -> dict[str, Track]:
    tracks, reasons = {}, []
    with progress_bar(len(corpus), "find the head") as advance:
        for clip in corpus:
            try:
                tracks[clip.path.name] = track_clip(clip.path, reference)
            except InputError as e:
                reasons.append(e)
            advance(1)
    if not tracks:
        raise reasons[0]
    return tracks


def _crops(clip: Clip, tracks: dict[str, Track], reference: Reference) -> list[F32]:
    return list(crops(clip.path, tracks[clip.path.name], reference.region))


def _bytes(image: F32) -> NDArray[np.uint8]:
    return np.round(image * 255).astype(np.uint8)


def _loudness(clip: Clip, sync: float) -> Floats:
    """RMS of the sound in each frame, (T,); zero without sound."""
    if not clip.info.has_sound:
        return np.zeros(clip.info.frames)
    samples, rate = read_sound(clip.path)
    late = round(sync * rate)
    moved = np.pad(samples, (late, 0)) if late > 0 else samples[-late:]
    return energy(moved, rate, clip.info.frames, float(clip.info.fps))


def _most_usual(coordinates: F32, allowed: NDArray[np.bool_]) -> int:
    """The allowed frame nearest to the median of the allowed ones."""
    numbers = np.flatnonzero(allowed)
    middle = np.median(coordinates[numbers], axis=0)
    return int(numbers[((coordinates[numbers] - middle) ** 2).sum(axis=1).argmin()])


def _most_open_frame(
    corpus: Sequence[Clip], tracks: dict[str, Track], reference: Reference, closed: int
) -> int:
    match, weight = matcher(), lip_mask(reference.region)
    clip, t = _place(corpus, closed)
    origin = _crops(clip, tracks, reference)[t]
    scores = []
    for clip in corpus:
        good = tracks[clip.path.name].registered
        for image, usable in zip(_crops(clip, tracks, reference), good, strict=True):
            flow = match(origin, image)
            scores.append(openness(flow, reference.region, weight) if usable else -np.inf)
    return int(np.argmax(scores))


def _place(corpus: Sequence[Clip], number: int) -> tuple[Clip, int]:
    """The clip and its frame that are `number` of all frames in a row."""
    for clip in corpus:
        if number < clip.info.frames:
            return clip, number
        number -= clip.info.frames
    raise IndexError(number)


def _carried(region: Region, pose: Floats) -> tuple[float, float, float]:
    """The mouth (x, y, width) [px] where `pose` sees it."""
    x, y, width = region.mouth
    ends = project(pose, np.array([[x, y], [x - width / 2, y], [x + width / 2, y]]))
    return float(ends[0, 0]), float(ends[0, 1]), float(np.hypot(*(ends[2] - ends[1])))
