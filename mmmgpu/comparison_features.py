"""Where the features of a comparison come from: saved files, an AAM, or the morphable model.

What is learned is learned anew for each fold, from its training clips alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.labelled import Floats
from mmmgpu.models import Model, project_on_simplex
from mmmgpu.reconstruction import Analysed, analyse_clip, reconstructed_frames
from mmmgpu.sounds import read_sound
from mmmgpu.training import Options, train
from mmmgpu.video_writing import write_video

Picture = NDArray[np.uint8]


class Eye(Protocol):
    """Sees features of clips, and shows features as a video of the clip."""

    def features(self, clip: Clip) -> Floats:
        """Features of every frame of `clip`, shape (T, d)."""
        ...

    def render(self, clip: Clip, features: Floats, out: Path) -> None:
        """Write `clip` with its face as `features` (T, d) have it, and with its sound."""
        ...


class Features(Protocol):
    """A way to come by features; it is sent to other processes."""

    def facts(self) -> dict[str, Any]:
        """What the features depend on beside the clips: JSON values."""
        ...

    def learn(self, clips: Sequence[Clip], folder: Path, fold: int) -> Eye:
        """Learn from `clips`; `folder` may keep what is learned for the fold of this number."""
        ...


def _stats(folder: Path) -> list[list[str | int]]:
    """Name, size and time of the files of numbers in `folder`."""
    files = sorted(f for f in folder.glob("*") if f.suffix in (".npz", ".json"))
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in files]


@dataclass(frozen=True)
class SavedFeatures:
    """``NAME.npz`` for every clip ``NAME.*`` in a folder, which holds `features` (T, d)."""

    folder: Path

    def facts(self) -> dict[str, Any]:
        """Names, sizes and times of the files."""
        return {"saved": _stats(self.folder)}

    def learn(self, clips: Sequence[Clip], folder: Path, fold: int) -> SavedFeatures:
        """Nothing is to be learned."""
        return self

    def features(self, clip: Clip) -> Floats:
        """Those of the file.

        Raises:
            InputError: There is none, or it holds no features.
        """
        path = self.folder / f"{clip.path.stem}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return np.asarray(arrays["features"], np.float64)
        except (OSError, EOFError, LookupError, TypeError, ValueError, BadZipFile) as e:
            raise InputError(
                f"{path}: no features of {clip.path} ({e}); save them as the array 'features'"
            ) from e

    def render(self, clip: Clip, features: Floats, out: Path) -> None:
        """Saved features cannot be shown.

        Raises:
            InputError: Always.
        """
        raise InputError("saved features have no pictures; use --features aam or mmm for videos")


@dataclass(frozen=True)
class AamFeatures:
    """Parameters of an active appearance model, from landmarks of every frame.

    options: keywords of `aam_training.fit_aam`, where they are not its defaults.
    """

    landmarks: Path
    backend: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def facts(self) -> dict[str, Any]:
        """Names, sizes and times of the landmarks, and the options."""
        facts = {"aam": _stats(self.landmarks), "backend": self.backend}
        return facts | {"options": dict(self.options)}

    def learn(self, clips: Sequence[Clip], folder: Path, fold: int) -> Eye:
        """An AAM of the clips."""
        from mmmgpu.aam import fit_aam

        paths = [clip.path for clip in clips]
        aam = fit_aam(paths, self.landmarks, backend=self.backend, **self.options)
        return _AamEye(aam, self.landmarks, self.backend)


@dataclass(frozen=True)
class _AamEye:
    aam: Any
    landmarks: Path
    backend: str

    def features(self, clip: Clip) -> Floats:
        from mmmgpu.aam import features

        return np.asarray(features(self.aam, clip.path, self.landmarks, backend=self.backend))

    def render(self, clip: Clip, features: Floats, out: Path) -> None:
        from mmmgpu.aam import reconstruct

        frames = reconstruct(self.aam, features, clip.path, self.landmarks, backend=self.backend)
        _write(clip, out, frames)


@dataclass(frozen=True)
class MmmFeatures:
    """alpha and beta of a morphable model, side by side, (T, 2 M - 1)."""

    alignments: Path
    backend: str
    options: Options = field(default_factory=Options)

    def facts(self) -> dict[str, Any]:
        """What the model is trained with."""
        return {"mmm": vars(self.options), "backend": self.backend}

    def learn(self, clips: Sequence[Clip], folder: Path, fold: int) -> Eye:
        """A model trained on the clips."""
        out = folder / f"fold-{fold}.mmm"
        paths = [clip.path for clip in clips]
        model = train(paths, self.alignments, out, options=self.options, backend=self.backend)
        return _MmmEye(model, self.backend, {})


@dataclass(frozen=True)
class _MmmEye:
    model: Model
    backend: str
    seen: dict[Path, Analysed]

    def features(self, clip: Clip) -> Floats:
        analysed = analyse_clip(self.model, clip.path, backend=self.backend)
        self.seen[clip.path] = analysed
        return np.concatenate([analysed.alpha, analysed.beta], axis=1)

    def render(self, clip: Clip, features: Floats, out: Path) -> None:
        moving = len(self.model.basis.images) - 1
        alpha, beta = features[:, :moving], project_on_simplex(features[:, moving:])
        shown = Analysed(self.seen[clip.path].track, alpha, beta)
        _write(clip, out, reconstructed_frames(self.model, clip.path, shown, backend=self.backend))


def _write(clip: Clip, out: Path, frames: Iterator[Picture]) -> None:
    from mmmgpu.parallel import one_thread_each

    sound = read_sound(clip.path, mono=False) if clip.info.has_sound else None
    with one_thread_each():
        write_video(out, frames, fps=clip.info.fps, sound=sound)


def features_named(
    name: str, *, alignments: Path, landmarks: Path | None, options: Mapping[str, Any], backend: str
) -> Features:
    """The features called `name`: aam, mmm, or a folder of saved ones.

    Args:
        name: As on the command line.
        alignments: As `train` wants them.
        landmarks: Folder of landmarks; for aam.
        options: For mmm: fields of `training.Options`; for aam: keywords of `fit_aam`.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: There is no such folder; landmarks are needed and not given.
    """
    if name == "aam":
        if landmarks is None:
            raise InputError(
                "--features aam needs the landmarks of the clips; give --landmarks DIR"
            )
        return AamFeatures(landmarks, backend, options)
    if name == "mmm":
        return MmmFeatures(alignments, backend, Options(**options))
    if not Path(name).is_dir():
        raise InputError(f"--features {name}: must be aam, mmm, or a folder of NAME.npz files")
    return SavedFeatures(Path(name))
