"""Pronunciation dictionaries of any language, in CMUdict's format, and the words of a transcript.

One line a word: the word, white space, its phones. A word with several pronunciations has several
lines, the later ones as `word(2)` or as the word again. Lines that begin with ;;; or # are
comments, and so is what follows a free-standing #. Which phones a language has is not known here:
they are what the dictionary uses. English without a dictionary is the business of pronunciation.
"""

import os
import re
import unicodedata
from collections.abc import Iterator, Mapping
from functools import lru_cache
from types import MappingProxyType

from mmmgpu.errors import InputError
from mmmgpu.files import read_text
from mmmgpu.phones import normalise_label

Lexicon = Mapping[str, tuple[tuple[str, ...], ...]]
Spoken = tuple[str, tuple[tuple[str, ...], ...]]  # a word and its pronunciations

_VARIANT = re.compile(r"(?<=.)\(\d+\)$")
_COMMENT = re.compile(r"(?:^|\s)#")
_NUMBER = re.compile(r"[-+]?\d*\.\d+")


def read_lexicon(path: str | os.PathLike[str]) -> Lexicon:
    """Read the dictionary in `path`: word -> its pronunciations, each a tuple of phones.

    Words are in lower case, stress digits go (see `phones.normalise_label`), and pronunciations
    that have become equal are one.

    Raises:
        InputError: The file cannot be read, holds no word, or a line has no phones or numbers in
            place of phones; names path and line.
    """
    found: dict[str, dict[tuple[str, ...], None]] = {}
    label_of = lru_cache(maxsize=None)(normalise_label)
    for number, line in enumerate(read_text(path).splitlines(), 1):
        columns = _columns(line)
        if not columns:
            continue
        if len(columns) < 2 or any("." in c and _NUMBER.fullmatch(c) for c in columns[1:]):
            raise InputError(
                f"{path}:{number}: expected 'word PHONE PHONE ...', found {line.strip()[:40]!r}; "
                "correct the line"
            )
        word = _plain(_VARIANT.sub("", columns[0]) if line.count("(") else columns[0])
        found.setdefault(word, {})[tuple(map(label_of, columns[1:]))] = None
    if not found:
        raise InputError(f"{path}: holds no word; give a dictionary with lines 'word PHONE ...'")
    return MappingProxyType({word: tuple(phones) for word, phones in found.items()})


def _columns(line: str) -> list[str]:
    """Return what `line` holds beside comments."""
    if line.startswith(";;;"):
        return []
    return (_COMMENT.split(line, maxsplit=1)[0] if "#" in line else line).split()


def look_up(text: str, lexicon: Lexicon, path: str | os.PathLike[str]) -> list[Spoken]:
    """Return the words of `text`, which white space and punctuation part, as they are in `lexicon`.

    Case does not matter. A word with punctuation inside (don't, e-mail) is taken whole where the
    dictionary has it so, else its parts are.

    Raises:
        InputError: A word is not in the dictionary, which was read from `path`.
    """
    return [(w, lexicon[w]) for token in _plain(text).split() for w in _words(token, lexicon, path)]


def _words(token: str, lexicon: Lexicon, path: str | os.PathLike[str]) -> Iterator[str]:
    for word in (token, _bare(token, keep="'"), _bare(token)):
        if word in lexicon:
            yield word
            return
    for word in "".join(c if _is_sounded(c) else " " for c in token).split():
        if word not in lexicon:
            raise InputError(
                f"{word!r} is not in the dictionary {path}; add it there or correct the transcript"
            )
        yield word


def _bare(token: str, *, keep: str = "") -> str:
    """Return `token` without punctuation about it, but that of `keep`."""
    kept = [i for i, c in enumerate(token) if _is_sounded(c) or c in keep]
    return token[kept[0] : kept[-1] + 1] if kept else ""


def _is_sounded(character: str) -> bool:
    """Whether it is a letter, an accent or a digit, and no punctuation, symbol or space."""
    return unicodedata.category(character)[0] in "LMN"


def _plain(text: str) -> str:
    """Return `text` in one form of Unicode, in lower case, with straight apostrophes."""
    if text.isascii():
        return text.lower()
    straight = text.replace("\u2019", "'").replace("\u2018", "'")
    return unicodedata.normalize("NFC", straight).lower()
