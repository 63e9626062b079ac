"""Alignment by phone models that are trained on the very clips to be aligned (ECR07 section 2).

Sound and transcripts in, phones and words with their times out. No acoustic model is needed, and
any language will do that has a pronunciation dictionary. The parts: features (mfcc), what a
transcript allows (phone_networks), the models (phone_hmms) and their training (hmm_training).
aligner is for English alone, with a model that others have trained. See docs/alignment.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.alignments import Alignment, Segment, cover
from mmmgpu.checkpoints import read_step, write_step
from mmmgpu.errors import InputError
from mmmgpu.hmm_training import BREATH_STATES, STATES, Utterance, flat_start, train
from mmmgpu.lexicons import Spoken
from mmmgpu.mfcc import SHIFT, mfcc
from mmmgpu.parallel import one_thread_each
from mmmgpu.phone_hmms import PhoneHmms, log_components, log_densities, viterbi
from mmmgpu.phone_networks import BREATH, PAUSE, Network, unroll
from mmmgpu.phones import SIL
from mmmgpu.sounds import checked_speech

LARGEST: Final = 20_000_000  # frames times states of one clip; each takes some 50 bytes
OUTLIER: Final = 6.0  # robust deviations above the median: a misfit that is to be looked at
FEWEST_CLIPS: Final = 8  # with fewer nothing can be said of what is usual
_STEP: Final = "training"  # of the checkpoints


@dataclass(frozen=True)
class Recording:
    """One clip: its features, (T, D), its duration [s], and its words with their pronunciations."""

    features: NDArray[np.float64]
    duration: float
    words: tuple[Spoken, ...]


@dataclass(frozen=True)
class Trained:
    """Phone models, and the log likelihood of all frames before each round of their training."""

    hmms: PhoneHmms
    log_likelihoods: tuple[float, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """What can be said of them in a few JSON values."""
        return {
            "phones": list(self.hmms.states),
            "gaussians": int((self.hmms.weights > 0).sum()),
            "log_likelihoods": list(self.log_likelihoods),
        }


def make_recording(samples: ArrayLike, rate: int, words: Sequence[Spoken]) -> Recording:
    """Return the clip that is to be learned from and aligned.

    Args:
        samples: Sound, mono, shape (N,), in [-1, 1].
        rate: Samples a second.
        words: What is said, of `lexicons.look_up` or `pronunciation`.

    Raises:
        InputError: There is no sound or no word; the clip is too short for its words, or too long.
    """
    if not words:
        raise InputError("the transcript has no words; give what is said")
    sound = checked_speech(samples, rate)
    features, duration = mfcc(sound, rate), len(sound) / rate
    fewest = STATES * sum(min(map(len, said)) for _, said in words)
    if len(features) < fewest:
        raise InputError(
            f"the transcript ({len(words)} words) takes at least {fewest * SHIFT:.2f} s to say but "
            f"the sound lasts {duration:.2f} s; give the words that are said in this clip"
        )
    pauses = (len(words) + 1) * (2 * STATES + BREATH_STATES)
    most = STATES * sum(sum(map(len, said)) for _, said in words) + pauses
    if len(features) * most > LARGEST:
        raise InputError(
            f"the clip ({duration:.0f} s, {len(words)} words) is too long to be aligned in one "
            "piece; cut it into clips of a minute at most, in pauses"
        )
    return Recording(features, duration, tuple(words))


def train_hmms(
    recordings: Sequence[Recording],
    *,
    breath: bool = False,
    folder: Path | None = None,
    advance: Callable[[int], None] = lambda n: None,
) -> Trained:
    """Return models of all phones in `recordings`, learned from these alone.

    The same recordings in the same order give the same bits.

    Args:
        recordings: At least one.
        breath: Whether pauses may hold breaths, which become the phone `BREATH`.
        folder: Of finished steps (see checkpoints.open_checkpoints); training goes on after the
            last round in it.
        advance: Called with the number of recordings that one more round has been done with.
    """
    spoken = {p for r in recordings for _, said in r.words for phones in said for p in phones}
    labels = sorted(spoken | {SIL} | ({BREATH} if breath else set()))
    hmms = flat_start(labels, [r.features for r in recordings])
    utterances = [Utterance(r.features, _network(hmms, r)) for r in recordings]
    trained = Trained(hmms, ()) if folder is None else _read(folder, hmms)
    done = len(trained.log_likelihoods)
    advance(done * len(recordings))
    for hmms, log_likelihood in train(trained.hmms, utterances, first=done, advance=advance):
        trained = Trained(hmms, (*trained.log_likelihoods, log_likelihood))
        if folder is not None:
            _write(folder, trained)
    return trained


def align(hmms: PhoneHmms, recording: Recording) -> Alignment:
    """Return when the words and phones of `recording` are said, by the most likely way (Viterbi).

    Boundaries lie between frames, `SHIFT` apart. Phones cover the clip.
    """
    network = _network(hmms, recording)
    with one_thread_each():
        log_b = log_densities(hmms, network, recording.features)
    path = viterbi(network, hmms.stay[network.state], log_b)
    times = [*(np.arange(len(log_b)) * SHIFT).round(6).tolist(), recording.duration]
    unit = network.unit[path.states]
    word = np.array([u.word for u in network.units])[unit]
    phones = [Segment(network.units[u].label, times[a], times[b]) for u, a, b in _runs(unit)]
    words = [
        Segment(recording.words[w][0], times[a], times[b]) for w, a, b in _runs(word) if w != PAUSE
    ]
    return Alignment(cover(phones, recording.duration), tuple(words), recording.duration)


def misfit(hmms: PhoneHmms, recording: Recording, alignment: Alignment) -> float:
    """How much better another phone explains a frame than the one it is aligned with [nats].

    The mean over all frames that are not silent; 0 if each is explained best by its own. Wrong
    words are forced on the sound and fit it badly; the likelihood alone would not tell, for it
    depends on the clip's noise more than on its words.
    """
    with one_thread_each():
        every = np.arange(len(hmms.means))
        log_b = np.logaddexp.reduce(log_components(hmms, every, recording.features), axis=2)
    best = np.stack([log_b[:, list(states)].max(axis=1) for states in hmms.states.values()], axis=1)
    times = (np.arange(len(best)) + 0.5) * SHIFT
    ends = [phone.end for phone in alignment.phones[:-1]]
    said = np.searchsorted(ends, times, side="right")
    rows = {label: row for row, label in enumerate(hmms.states)}
    own = np.array([rows[phone.label] for phone in alignment.phones])[said]
    speech = own != rows[SIL]
    gaps = best.max(axis=1) - best[np.arange(len(best)), own]
    return float(gaps[speech].mean()) if speech.any() else 0.0


def suspects(misfits: ArrayLike) -> NDArray[np.bool_]:
    """Which clips fit their transcripts far worse than the others do, by their misfits (N,).

    More than `OUTLIER` deviations above the median, the deviation taken from the median of
    absolute differences; none of fewer than `FEWEST_CLIPS`.
    """
    values = np.asarray(misfits, np.float64)
    if len(values) < FEWEST_CLIPS:
        return np.zeros(len(values), bool)
    above = values - np.median(values)
    deviation = 1.4826 * np.median(np.abs(above))  # that of a normal distribution
    return np.asarray(above > OUTLIER * deviation)


def _network(hmms: PhoneHmms, recording: Recording) -> Network:
    """Return all ways to say the words of `recording`, with breaths where `hmms` have them."""
    words = [said for _, said in recording.words]
    return unroll(words, hmms.states, breath=BREATH in hmms.states)


def _runs(names: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return each run of equal names: the name, its first frame, and the one after its last."""
    first = [0, *(np.flatnonzero(np.diff(names)) + 1).tolist(), len(names)]
    return [(int(names[a]), a, b) for a, b in pairwise(first)]


def _read(folder: Path, hmms: PhoneHmms) -> Trained:
    """Return what training had come to, from the start `hmms`."""
    step = read_step(folder, _STEP)
    if step is None:
        return Trained(hmms, ())
    log_likelihoods = tuple(step.pop("log_likelihoods").tolist())
    return Trained(PhoneHmms(states=hmms.states, **step), log_likelihoods)


def _write(folder: Path, trained: Trained) -> None:
    arrays = {
        name: getattr(trained.hmms, name) for name in ("weights", "means", "variances", "stay")
    }
    write_step(folder, _STEP, {**arrays, "log_likelihoods": np.array(trained.log_likelihoods)})
