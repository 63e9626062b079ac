"""Small worlds for tests: a drawn person who says a few phones, in clips with sound."""

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from mmmgpu.alignments import Alignment, Segment, cover, write_textgrid
from mmmgpu.basis import make_basis
from mmmgpu.brand import Brand
from mmmgpu.dpds import Dpds
from mmmgpu.flows import matcher
from mmmgpu.hmm_mean import HmmMean
from mmmgpu.models import Calm, Model
from mmmgpu.performer import (
    ARTICULATORS,
    Articulation,
    Performer,
    articulate,
    landmarks,
    performer,
    render,
)
from mmmgpu.performer_articulation import REST
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.regions import region_around
from mmmgpu.registration import Head
from mmmgpu.slds import Slds
from mmmgpu.tracked_clips import TrackedClip
from mmmgpu.tracks import Reference, Track
from mmmgpu.trajectory_training import Constants, History, TrainedStream
from mmmgpu.video_writing import write_video

FPS = 25
RATE = 8000
SENTENCES = (
    "B IY M AA W UW F AE",
    "L OW S EH P AH D IY",
    "SH UW K AA N EY V ER",
    "G AE B OW T IY M UW",
)


@dataclass(frozen=True)
class World:
    """Clips of one performer with their truth.

    face: who speaks. clips: video files. motions: what each clip shows.
    alignments: the folder of their TextGrids. sentences: the phones of each clip.
    """

    face: Performer
    clips: tuple[Path, ...]
    motions: tuple[Articulation, ...]
    alignments: Path
    sentences: tuple[str, ...]


def texture(height, width, *, grain=2.0, seed=0):
    """A smooth random RGB picture (H, W, 3) in [0, 1]; `grain` is the size of its spots [px]."""
    noise = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), grain)
    return (soft - soft.min()) / (soft.max() - soft.min())


def say(sentence, *, phone=0.15, silence=0.3):
    """The phones of `sentence` with silence about them."""
    labels = sentence.split()
    times = silence + phone * np.arange(len(labels) + 1)
    said = [Segment(label, *t) for label, *t in zip(labels, times, times[1:], strict=False)]
    duration = np.ceil((times[-1] + silence) * FPS) / FPS
    return Alignment(cover(said, duration), (), float(duration))


def voice(alignment, rng):
    """Noise (n,) that is loud in vowels and all but absent in silence."""
    samples = np.zeros(round(alignment.duration * RATE))
    for label, start, end in alignment.phones:
        loudness = 0.002 if label == "SIL" else 0.3 if label[0] in "AEIOU" else 0.1
        part = slice(round(start * RATE), round(end * RATE))
        samples[part] = loudness * rng.standard_normal(len(samples[part]))
    return np.clip(samples, -1, 1).astype(np.float32)


def sentence_motion(face, alignment, rng):
    """How `face` says `alignment`, with head motion and blinks."""
    frames = round(alignment.duration * FPS)
    return articulate(face, alignment.phones, frames, FPS, rng)


def make_world(folder, *, seed=5, size=(160, 144), sentences=SENTENCES):
    """Render `sentences` into `folder`, losslessly, with camera noise and head motion."""
    face = performer(seed, size=size)
    clips, motions = [], []
    for i, sentence in enumerate(sentences):
        rng = np.random.default_rng([seed, i])
        alignment = say(sentence)
        motion = sentence_motion(face, alignment, rng)
        clip = folder / f"clip {i}.mkv"
        sound = (voice(alignment, rng), RATE)
        write_video(clip, render(face, motion, rng=rng), fps=FPS, sound=sound, lossless=True)
        write_textgrid(alignment, clip.with_suffix(".TextGrid"))
        clips.append(clip)
        motions.append(motion)
    return World(face, tuple(clips), tuple(motions), folder, tuple(sentences))


POSTURES = (
    {},
    {"jaw": 0.5, "press": 0.0},
    {"jaw": 0.9, "press": 0.0, "lower_lip": 0.4, "upper_lip": 0.3},
    {"width": 0.1, "round": 0.9, "press": 0.0, "jaw": 0.2},
    {"width": 0.95, "press": 0.0, "lower_lip": 0.5, "upper_lip": 0.4},
)


def hold(*postures, pose=None):
    """One frame a posture: articulators that differ from rest; `pose` (T, 4) of the head."""
    rest = dict(zip(ARTICULATORS, REST, strict=True))
    values = np.array([list((rest | posture).values()) for posture in postures])
    n = len(values)
    pose = np.zeros((n, 4)) if pose is None else np.asarray(pose, float)
    return Articulation(values, pose, np.zeros(n), np.zeros((n, 2)), float(FPS))


def mouth_pictures(face, motion, region):
    """The region of every frame, (T, h, w, 3) float32 in [0, 1]; the head keeps still."""
    x, y, w, h = region.box
    frames = np.stack(list(render(face, motion)))
    return np.ascontiguousarray(frames[:, y : y + h, x : x + w].astype(np.float32) / 255)


def make_postures(seed=5, size=(160, 144)):
    """A performer, the region of its mouth, and a basis of `POSTURES` (the first: reference)."""
    face = performer(seed, size=size)
    motion = hold(*POSTURES)
    lips = landmarks(face, motion, 0)[:20]
    mouth = (*lips.mean(axis=0), np.ptp(lips[:, 0]))
    region = region_around(mouth, (size[1], size[0]))
    images = mouth_pictures(face, motion, region)
    match = matcher("dis")
    flows = np.stack([match(images[0], image) for image in images])
    return face, make_basis(images, flows, 0, region)


def make_stream(rng, dims, labels=("AA", "M", "SIL")):
    """Phoneme models of one stream that nobody has trained."""
    shape = (len(labels), dims)
    count = np.arange(5, 5 + len(labels))
    pooled, trained = (
        PhonemeModels(tuple(labels), rng.normal(size=shape), rng.uniform(0.5, 2, shape), count)
        for _ in range(2)
    )
    history = History(rng.random((4, dims)))
    constants = Constants(smoothness=2.0, order=3, ridge=4.0, iterations=3)
    return TrainedStream(pooled, trained, rng.random(dims), constants, history, rng.random(6))


def make_dynamics(rng, dims, labels=("AA", "M", "SIL")):
    """Models of movement of one stream that nobody has fitted, by name."""

    def one(low, high, *shape):
        return rng.uniform(low, high, shape or (len(labels) + 1, dims))

    return {
        "hmm": HmmMean(labels, one(-1, 1), one(0.1, 1)),
        "brand": Brand(labels, one(-1, 1), one(0.1, 1), one(-1, 1), one(0.1, 1)),
        "slds": Slds(
            labels, one(-1, 1), one(0.1, 1), one(0, 0.9), one(-1, 1), one(0.1, 1), one(0.1, 1)
        ),
        "dpds": Dpds(labels, one(-1, 1), one(0, 0.9), one(-1, 1), one(0.1, 1, dims)),
    }


def make_model(basis, *, seed=0):
    """A whole model about `basis` of which every number is another, for files and readers."""
    rng = np.random.default_rng(seed)
    count = len(basis.images)
    poses = np.eye(3) + 0.01 * rng.normal(size=(7, 3, 3))
    registered = rng.random(7) > 0.3
    track = Track(poses, registered, rng.random(7), rng.random(3), rng.random(3), 0.125)
    first = replace(
        track, poses=poses[:4], registered=registered[:4], correlation=track.correlation[:4]
    )
    head = Head(
        rng.integers(0, 256, (9, 11), np.uint8), rng.random((9, 11), np.float32), poses[0] * 2
    )
    points = rng.random((13, 2))
    movers = [make_dynamics(np.random.default_rng(seed), dims) for dims in (count - 1, count)]
    reference = Reference(head, rng.random((13, 3), np.float32), points, basis.region)
    return Model(
        basis=basis,
        reference=reference,
        alpha=make_stream(rng, count - 1),
        beta=make_stream(rng, count),
        fps=Fraction(30000, 1001),
        prototype_frames=rng.integers(0, 256, (count, 50, 60, 3), np.uint8),
        sources=tuple((f"clip ü {i}.mkv", 10 * i) for i in range(count)),
        calm=Calm(rng.integers(0, 256, 100, np.uint8), ".mkv", track),
        notes={"skipped": {"a.mkv": "why"}, "seed": 3, "residual": 0.1},
        dynamics={name: (movers[0][name], movers[1][name]) for name in movers[0]},
        tracked={
            "b ü.mkv": TrackedClip("ab" * 32, replace(track, residual=0.5)),
            "a.mkv": TrackedClip("cd" * 32, first),
        },
    )
