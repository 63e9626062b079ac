"""Two drawn persons: one with a model, and one of whom there are a few seconds."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from commands import trained_model
from worlds import World, make_world

import mmmgpu.corpus_steps
from mmmgpu.landmark_points import points_from_landmarks
from mmmgpu.model_files import load
from mmmgpu.performer import landmarks
from mmmgpu.points import write_points
from mmmgpu.reference_pairs import choose_references, source_references

SECOND = ("P AA M IY B UW F AE", "S OW L EH T AH W IY")


@dataclass(frozen=True)
class TwoPersons:
    """source: model file of the first. second: the other's clips. points: file of both's points."""

    source: Path
    second: World
    points: Path


def interrupt_second_step(monkeypatch):
    """Ctrl-C comes when work is shared out for the second time; the list of what was shared out."""
    share_out, calls = mmmgpu.corpus_steps.share_out, []

    def once(*args, **options):
        calls.append(args[2])
        if len(calls) == 2:
            raise KeyboardInterrupt
        share_out(*args, **options)

    monkeypatch.setattr(mmmgpu.corpus_steps, "share_out", once)
    return calls


def write_landmarks(world):
    """True landmarks beside each clip, as trackers leave them."""
    for clip, motion in zip(world.clips, world.motions, strict=True):
        points = [landmarks(world.face, motion, t) for t in range(len(motion))]
        np.savez(clip.with_suffix(".npz"), points=np.array(points, np.float32))


def make_two_persons(world, folder):
    """The person of `world` and a second one, filmed into `folder`."""
    source = trained_model(world)
    second = make_world(folder, seed=8, sentences=SECOND)
    write_landmarks(world)
    write_landmarks(second)
    shown = source_references(load(source)), choose_references(second.clips)
    points = folder / "points.json"
    write_points(points, points_from_landmarks(*shown, world.alignments, folder))
    return TwoPersons(source, second, points)
