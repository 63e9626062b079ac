"""Small studies: clips under four conditions, a plan without clips, and a person who answers."""

import http.client
import json
from urllib.parse import urlsplit

import numpy as np
from media import tone

from mmmgpu.studies import Pair, Participant, Study, StudyClip
from mmmgpu.study_plans import draw_plan
from mmmgpu.video_writing import write_video

CONDITIONS = ("brand", "dpds", "reality", "slds")
SENTENCES = ("lay blue", "set red", "bin white")
N_FRAMES, SIZE = 10, (48, 64)


def pictures(condition, *, frames=N_FRAMES, size=SIZE):
    """Frames of a bar that moves right on a ground whose grey tells the condition."""
    level = 40 + 45 * CONDITIONS.index(condition)
    shown = np.full((frames, *size, 3), level, np.uint8)
    for t in range(frames):
        shown[t, :, 4 * t : 4 * t + 8] = 250
    return list(shown)


def seen_condition(frame):
    """The condition that a frame of `pictures` shows, also after lossy coding."""
    level = np.median(frame[:, -8:].astype(float))
    return CONDITIONS[round((level - 40) / 45)]


def seen_step(frame):
    """Where the bar of `pictures` is, in frames from the first."""
    bright = np.flatnonzero(frame.mean(axis=(0, 2)) > 220)
    return round((bright.mean() - 3.5) / 4)


def write_clip(folder, condition, sentence, *, suffix=".mp4", rate=16000, **look):
    """Write a clip into FOLDER/CONDITION; each condition's sound has its own pitch."""
    (folder / condition).mkdir(parents=True, exist_ok=True)
    frames = pictures(condition, **look)
    hertz = 300 + 200 * CONDITIONS.index(condition)
    sound = None if rate is None else (tone(len(frames) / 25, rate, hertz=hertz), rate)
    path = folder / condition / f"{sentence}{suffix}"
    write_video(path, frames, fps=25, sound=sound)
    return path


def write_clips(folder, *, conditions=CONDITIONS, sentences=SENTENCES):
    """Write a folder of clips for each condition."""
    for condition in conditions:
        for sentence in sentences:
            write_clip(folder, condition, sentence)
    return folder


def planned(*, conditions=CONDITIONS, sentences=SENTENCES, participants=4, seed=0, **numbers):
    """A study without clips."""
    numbers = {"checks": 2, **numbers}
    clips = {
        (sentence, condition): StudyClip(f"{i}{j}", sentence, condition)
        for i, sentence in enumerate(sentences)
        for j, condition in enumerate((*conditions, None))
    }
    plan = draw_plan(
        conditions,
        sentences,
        real=conditions[-1],
        participants=participants,
        rng=np.random.default_rng(seed),
        **numbers,
    )
    people = tuple(
        Participant(
            f"token-{n}",
            tuple(Pair(clips[p.sentence, p.left], clips[p.sentence, p.right]) for p in pairs),
        )
        for n, pairs in enumerate(plan, start=1)
    )
    return Study(
        id=f"study{seed}",
        seed=seed,
        conditions=tuple(conditions),
        real=conditions[-1],
        introduction="Which?",
        clips=tuple(clips.values()),
        participants=people,
    )


class Person:
    """Somebody with a link, over one connection that is opened again where it was lost."""

    def __init__(self, link):
        self._parts = urlsplit(link)
        self._connection = self._connect()

    def _connect(self):
        return http.client.HTTPConnection(self._parts.hostname, self._parts.port, timeout=30)

    def ask(self, path="", method="GET", body=None, **headers):
        """Send a request; status, headers and content of the answer."""
        body = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            self._connection.request(method, f"{self._parts.path}{path}", body, names)
            answer = self._connection.getresponse()
            return answer.status, answer.headers, answer.read()
        except (OSError, http.client.HTTPException):
            self.leave()
            raise

    def get(self, path):
        return json.loads(self.ask(path)[2])

    def answer(self, pair, choice):
        """Answer a pair; the status and what the server says."""
        status, _, content = self.ask(f"pairs/{pair}/answer", "POST", {"choice": choice})
        return status, json.loads(content)

    def leave(self):
        self._connection.close()
        self._connection = self._connect()
