"""`train` and `speak` from end to end on the drawn performer, and where their time goes.

The profile is by samples: every few milliseconds, which function of mmmgpu each thread is in.
Threads that wait are not counted. Child processes, which track and analyse clips, are sampled by
none; their time is that in which the parent waits for them.
"""

import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

from mmmgpu.performances import SENTENCES, Stage, make_corpus
from mmmgpu.speaking import speak
from mmmgpu.training import Options, train
from mmmgpu.voices import say

EVERY = 0.005  # s
SHOWN = 12
WAITING = (
    "endings.py",
    "threading.py",
    "queue.py",
    "selectors.py",
    "_base.py",
    "connection.py",
    "subprocess.py",
)
CLIPS = 4
TEXT = "The boy bought a big blue boat."


def measure_pipeline(backend, *, size=(160, 144), prototypes=46, clips=CLIPS):
    """Seconds, frames a second and profile of each step; espeak-ng gives the performer a voice."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        out, stage = Path(folder), Stage(size=size)
        corpus = make_corpus(out / "corpus", seed=23, sentences=SENTENCES[:clips], stage=stage)
        with step(found, "train"):
            options = Options(prototypes=prototypes)
            model = train(corpus, out / "corpus", out / "a.mmm", options=options, backend=backend)
        speech = say(TEXT)
        with step(found, "speak"):
            spoken = speak(model, speech, out / "a.mp4", backend=backend)
    found["speak"]["frames_per_second"] = round(len(spoken) / found["speak"]["seconds"], 1)
    return {"backend": backend, "clips": clips, "size": list(size), "steps": found}


@contextmanager
def step(found, name):
    """Take the time and the profile of what is inside."""
    counts, done = Counter(), threading.Event()
    sampler = threading.Thread(target=sample, args=(counts, done), daemon=True)
    start = time.perf_counter()
    sampler.start()
    try:
        yield
    finally:
        done.set()
        sampler.join()
    seconds = time.perf_counter() - start
    total = sum(counts.values()) or 1
    profile = {where: round(n / total, 3) for where, n in counts.most_common(SHOWN)}
    found[name] = {"seconds": round(seconds, 2), "profile": profile}


def sample(counts, done):
    """Count where the threads are until `done`."""
    own = threading.get_ident()
    while not done.wait(EVERY):
        for thread, frame in sys._current_frames().items():
            where = None if thread == own else place(frame)
            if where:
                counts[where] += 1


def place(frame):
    """The innermost function of mmmgpu, as module.function; None where the thread waits."""
    if frame.f_code.co_filename.endswith(WAITING):
        return None
    while frame is not None:
        name = frame.f_globals.get("__name__", "")
        if name.startswith("mmmgpu.") and not name.startswith("mmmgpu.bench"):
            return f"{name.removeprefix('mmmgpu.')}.{frame.f_code.co_name}"
        frame = frame.f_back
    return None
