"""Made-up phone models, features drawn from them, and sounds of a language that nobody speaks."""

import numpy as np

from mmmgpu.phone_hmms import PhoneHmms
from mmmgpu.phone_networks import BREATH

LENGTHS = {"A": 2, "B": 1, BREATH: 1, "SIL": 1}


def make_hmms(seed, lengths=LENGTHS, gaussians=2, dims=2):
    """Phone models in which all is drawn at random."""
    rng = np.random.default_rng(seed)
    states, q = {}, 0
    for label, n in lengths.items():
        states[label], q = range(q, q + n), q + n
    weights = rng.dirichlet(np.ones(gaussians), q)
    shape = (q, gaussians, dims)
    means, variances = rng.normal(0, 1.5, shape), rng.uniform(0.3, 2, shape)
    return PhoneHmms(states, weights, means, variances, rng.uniform(0.2, 0.8, q))


def draw(hmms, labels, rng):
    """Frames (T, D) of `hmms` saying `labels`, and the index of the label of each frame (T,)."""
    x, said = [], []
    for i, label in enumerate(labels):
        for q in hmms.states[label]:
            for _ in range(rng.geometric(1 - hmms.stay[q])):
                m = rng.choice(len(hmms.weights[q]), p=hmms.weights[q])
                x.append(rng.normal(hmms.means[q, m], np.sqrt(hmms.variances[q, m])))
                said.append(i)
    return np.array(x), np.array(said)


RATE = 16_000
SOUNDS = {  # of a made-up language: resonances of a voice [Hz], and noise
    "a": ((700, 1200, 2600), 0.0),
    "i": ((300, 2300, 3000), 0.0),
    "m": ((250, 1100), 0.0),
    "s": ((), 0.3),
    "o": ((450, 800, 2400), 0.0),
}
PITCH = 120  # Hz
NOISE = 0.002  # everywhere
LEXICON = """\
mása  m a s a
ìmo   i m o
so    s o
osim  o s i m
simo  s i m o
"""
SENTENCES = (
    "Mása ìmo so.",
    "Osim so, mása!",
    "So simo ìmo",
    "Ìmo mása osim",
    "Simo so mása",
    "Mása osim simo",
)


def sound_of(label, rng, n):
    """`n` samples of one sound: harmonics of a voice, loud near its resonances, and noise."""
    resonances, hiss = SOUNDS[label]
    harmonics = PITCH * np.arange(1, 60)
    loud = sum(np.exp(-np.abs(harmonics - f) / 250) for f in resonances) + 0.01 * bool(resonances)
    phase = 2 * np.pi * np.outer(np.arange(n) / RATE, harmonics)
    return 0.05 * (loud * np.cos(phase)).sum(axis=1) + rng.normal(0, hiss + NOISE, n)


def utter(sentence, rng, *, pause=0.3):
    """Sound (N,) of `sentence` in that language, and its phones as (label, start, end) [s]."""
    said = {line.split()[0]: line.split()[1:] for line in LEXICON.splitlines()}
    words = [word.strip(".,!").lower() for word in sentence.split()]
    row = [("SIL", pause), *((p, rng.uniform(0.07, 0.16)) for w in words for p in said[w])]
    samples, phones, now = [], [], 0.0
    for label, seconds in [*row, ("SIL", pause)]:
        n = round(seconds * RATE)
        if label == "SIL":
            samples.append(rng.normal(0, NOISE, n))
        else:
            samples.append(sound_of(label, rng, n))
            phones.append((label, now, now + n / RATE))
        now += n / RATE
    return np.concatenate(samples), phones
