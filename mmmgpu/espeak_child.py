"""espeak-ng in a process of its own: JSON on stdin, JSON and samples on stdout.

The library keeps its oscillators' phases in static memory, so that a second sentence of one process
sounds unlike the same sentence in a fresh one; it is not thread-safe, and a fault in it would take
the caller with it. A process for each call has none of this and costs about 50 ms. This file is run
by its path (see voices), imports only the standard library, and is never imported by the package.

Request: {"library", "voice", "rate", "text"} or {"library", "voice", "words"}; the working folder
is the one that holds espeak-ng-data (the library cuts long paths).
Reply: one line of JSON, {"error"} or {"rate", "events"} or {"ipa"}, then the samples, int16.
An event is (type, sample, text position from 1, length, IPA), types as in espeak's speak_lib.h.
"""

import ctypes
import json
import os
import sys
from typing import Any

AUDIO_OUTPUT_SYNCHRONOUS = 2
INITIALIZE = 0x1 | 0x2 | 0x8000  # phoneme events, in IPA, and do not exit on failure
EVENT_END_OF_LIST, EVENT_PHONEME = 0, 7
PARAMETER_RATE = 1
CHARS_UTF8 = 1
POSITION_CHARACTER = 1
PHONEMES_IPA = 2


class _EventId(ctypes.Union):
    _fields_ = (("number", ctypes.c_int), ("name", ctypes.c_char_p), ("string", ctypes.c_char * 8))


class Event(ctypes.Structure):
    """espeak_EVENT."""

    _fields_ = (
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        ("id", _EventId),
    )


CALLBACK = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(Event)
)


class Voice(ctypes.Structure):
    """espeak_VOICE."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("languages", ctypes.c_char_p),
        ("identifier", ctypes.c_char_p),
        ("gender", ctypes.c_ubyte),
        ("age", ctypes.c_ubyte),
        ("variant", ctypes.c_ubyte),
        ("xx1", ctypes.c_ubyte),
        ("score", ctypes.c_int),
        ("spare", ctypes.c_void_p),
    )


def set_voice(library: ctypes.CDLL, voice: bytes) -> bool:
    """Choose the voice of that name or language; return whether there is one."""
    if library.espeak_SetVoiceByName(voice) == 0:
        return True
    wanted = Voice(languages=voice)
    return bool(library.espeak_SetVoiceByProperties(ctypes.byref(wanted)) == 0)


def speak(library: ctypes.CDLL, text: str) -> tuple[list[tuple[int, int, int, int, str]], bytes]:
    """Return the events and the int16 samples (bytes) of `text`."""
    events: list[tuple[int, int, int, int, str]] = []
    sound: list[bytes] = []

    def receive(samples: Any, n_samples: int, batch: Any) -> int:
        if n_samples > 0:
            sound.append(ctypes.string_at(samples, 2 * n_samples))
        for event in batch:
            if event.type == EVENT_END_OF_LIST:
                return 0
            ipa = event.id.string.decode(errors="ignore") if event.type == EVENT_PHONEME else ""
            events.append((event.type, event.sample, event.text_position, event.length, ipa))
        return 0

    callback = CALLBACK(receive)
    library.espeak_SetSynthCallback(callback)
    data = text.encode() + b"\0"
    size = ctypes.c_size_t(len(data))
    library.espeak_Synth(data, size, 0, POSITION_CHARACTER, 0, CHARS_UTF8, None, None)
    library.espeak_Synchronize()
    return events, b"".join(sound)


def transcribe(library: ctypes.CDLL, word: str) -> str:
    """Return the pronunciation of `word` in IPA."""
    library.espeak_TextToPhonemes.restype = ctypes.c_char_p
    rest = ctypes.c_char_p(word.encode())
    parts = []
    while rest.value is not None:
        parts.append(library.espeak_TextToPhonemes(ctypes.byref(rest), CHARS_UTF8, PHONEMES_IPA))
    return " ".join(part.decode() for part in parts)


def answer(request: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """Return the reply to `request` and the samples that follow it."""
    library = ctypes.CDLL(request["library"])
    rate = library.espeak_Initialize(AUDIO_OUTPUT_SYNCHRONOUS, 0, b".", INITIALIZE)
    if rate <= 0:
        return {"error": "cannot be started; install it again"}, b""
    if not set_voice(library, request["voice"].encode()):
        return {"error": f"has no voice {request['voice']!r}; use one like 'en-us' or 'de'"}, b""
    if "words" in request:
        return {"ipa": [transcribe(library, word) for word in request["words"]]}, b""
    library.espeak_SetParameter(PARAMETER_RATE, request["rate"], 0)
    events, sound = speak(library, request["text"])
    return {"rate": rate, "events": events}, sound


def main() -> None:
    """Answer one request."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the library prints is not part of the reply
    reply, sound = answer(json.load(sys.stdin.buffer))
    out.write(json.dumps(reply).encode() + b"\n" + sound)
    out.close()


if __name__ == "__main__":
    main()
