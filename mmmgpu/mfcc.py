"""Mel-frequency cepstral coefficients: what speech sounds like, 100 times a second.

The 13 coefficients of ECR07 section 2 (there by HTK, here by kaldi-native-fbank, whose filters and
scale differ a little), less their mean over the clip, and their first and second derivatives in
time. Models of them are in phone_hmms.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmmgpu.errors import InputError
from mmmgpu.sounds import checked_speech, levelled

RATE: Final = 16_000  # Hz, of the sound that is analysed
SHIFT: Final = 0.01  # s; frame t is about [t, t + 1) * SHIFT and sees 25 ms around its centre
COEFFICIENTS: Final = 13  # the first of them is the loudness: the sum of the log filter outputs
_NOISE: Final = 2.0**-15  # deviation, of full scale; digital silence has no logarithm


def mfcc(samples: ArrayLike, rate: int, *, deltas: int = 2) -> NDArray[np.float64]:
    """Return the features of a clip, shape (T, 13 * (deltas + 1)): coefficients, then derivatives.

    The loudness of the whole clip does not matter. The same input gives the same bits.

    Args:
        samples: Sound, mono, shape (N,), in [-1, 1].
        rate: Samples a second.
        deltas: The highest derivative, by regression over 5 frames; 0 gives the coefficients alone.

    Raises:
        InputError: There is no sound to be analysed, or kaldi-native-fbank is not installed.
    """
    sound = levelled(checked_speech(samples, rate), rate, RATE)
    kaldi = _kaldi()
    extractor = kaldi.OnlineMfcc(_options(kaldi))
    noise = np.random.default_rng(0).normal(0.0, _NOISE, len(sound))
    extractor.accept_waveform(RATE, (32768 * (sound + noise)).astype(np.float32))
    extractor.input_finished()
    frames = [extractor.get_frame(t) for t in range(extractor.num_frames_ready)]
    if not frames:
        raise InputError("the sound is silent or too short; give a clip with speech")
    c = np.array(frames, np.float32)
    c -= c.mean(axis=0)
    with_deltas = kaldi.compute_deltas(kaldi.DeltaOptions(order=deltas, window=2), c)
    return np.asarray(with_deltas, np.float64)


def _kaldi() -> Any:
    try:
        import kaldi_native_fbank
    except ImportError as error:
        raise InputError("MFCC need kaldi-native-fbank; run pip install 'mmmgpu[align]'") from error
    return kaldi_native_fbank


def _options(kaldi: Any) -> Any:
    """Return what differs from the defaults of Kaldi: no chance, frames centred on their time."""
    options = kaldi.MfccOptions()
    options.frame_opts.samp_freq = RATE
    options.frame_opts.frame_shift_ms = 1000 * SHIFT
    options.frame_opts.dither = 0.0
    options.frame_opts.snip_edges = False
    options.num_ceps = COEFFICIENTS
    options.use_energy = False
    return options
