"""How English text is spoken: words as they are said, and the phones of a word.

CMUdict, from pocketsphinx's wheel, answers first; espeak-ng speaks what is not in it; where that is
not installed, plain letter rules do. No stress, and of several pronunciations the first: an aligner
may try the others.
"""

import re
import unicodedata
from collections.abc import Iterator, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Final

from mmmgpu.errors import InputError
from mmmgpu.lexicons import Lexicon, Spoken, read_lexicon

LONGEST_ACRONYM: Final = 5  # letters; longer words in capitals are shouted, not spelled
_SYMBOLS: Final = {
    "&": "and",
    "@": "at",
    "%": "percent",
    "+": "plus",
    "=": "equals",
    "$": "dollars",
    "£": "pounds",
    "€": "euros",
}
_TOKEN: Final = re.compile(
    r"(?P<money>[$£€])(?=\d)"
    r"|(?P<number>\d+(?:,\d{3})+(?:\.\d+)?|\d+(?:\.\d+)?)(?P<ending>st|nd|rd|th|'?s)?(?![^\W_])"
    r"|(?P<digits>\d+)"
    r"|(?P<initials>(?:[^\W\d_]\.){2,})"
    r"|(?P<word>'?[^\W\d_]+(?:'[^\W\d_]+)*'?)"
    r"|(?P<symbol>[&@%+=$£€])",
)

# fmt: off
_UNITS: Final = (
    "zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
    "twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen",
)
_TENS: Final = (
    "", "", "twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety",
)
_THOUSANDS: Final = ("", "thousand", "million", "billion", "trillion")
_ORDINALS: Final = {
    "one": "first", "two": "second", "three": "third", "five": "fifth", "eight": "eighth",
    "nine": "ninth", "twelve": "twelfth",
}
_LETTER_NAMES: Final = MappingProxyType({
    "a": "EY", "b": "B IY", "c": "S IY", "d": "D IY", "e": "IY", "f": "EH F", "g": "JH IY",
    "h": "EY CH", "i": "AY", "j": "JH EY", "k": "K EY", "l": "EH L", "m": "EH M", "n": "EH N",
    "o": "OW", "p": "P IY", "q": "K Y UW", "r": "AA R", "s": "EH S", "t": "T IY", "u": "Y UW",
    "v": "V IY", "w": "D AH B AH L Y UW", "x": "EH K S", "y": "W AY", "z": "Z IY",
})
_LETTER_RULES: Final = {  # the longest match wins
    "tch": "CH", "igh": "AY", "sch": "SH", "tion": "SH AH N", "ch": "CH", "sh": "SH", "th": "TH",
    "ph": "F", "ck": "K", "ng": "NG", "qu": "K W", "wh": "W", "ee": "IY", "ea": "IY", "oo": "UW",
    "ou": "AW", "ow": "OW", "oi": "OY", "oy": "OY", "ai": "EY", "ay": "EY", "au": "AO", "aw": "AO",
    "ar": "AA R", "er": "ER", "ir": "ER", "ur": "ER", "or": "AO R", "ce": "S", "ci": "S IH",
    "a": "AE", "b": "B", "c": "K", "d": "D", "e": "EH", "f": "F", "g": "G", "h": "HH", "i": "IH",
    "j": "JH", "k": "K", "l": "L", "m": "M", "n": "N", "o": "AA", "p": "P", "q": "K", "r": "R",
    "s": "S", "t": "T", "u": "AH", "v": "V", "w": "W", "x": "K S", "y": "IY", "z": "Z",
}
# fmt: on


def spoken_words(text: str) -> list[str]:
    """Return the words of `text` in lower case as they are said; may be empty.

    Numbers, ordinals and signs become words, hyphens part words, initials and unknown short words
    in capitals become letters, accents and all other punctuation go.

    >>> spoken_words("Dr. O'Neil's 21st e-mail: 3.5% of the BBC's $12!")[:6]
    ['dr', "o'neil's", 'twenty', 'first', 'e', 'mail']
    """
    text = unicodedata.normalize("NFKC", text).replace("\u2019", "'").replace("\u2018", "'")
    words: list[str] = []
    money = ""
    for match in _TOKEN.finditer(text):
        if match["money"]:
            money = _SYMBOLS[match["money"]]
            continue
        words += _said(match)
        if money:
            words.append(money)
            money = ""
    return words


def _said(match: re.Match[str]) -> list[str]:
    if match["number"]:
        words = _number(match["number"])
        return _ended(words, match["ending"] or "")
    if match["digits"]:
        return _number(match["digits"])
    if match["initials"]:
        return [c for c in _plain(match["initials"]) if c.isalpha()]
    if match["symbol"]:
        return [_SYMBOLS[match["symbol"]]]
    return list(_word(match["word"]))


def _word(token: str) -> Iterator[str]:
    word = _plain(token)
    known = dictionary()
    if word not in known:
        word = word.strip("'")
    stem, apostrophe, ending = word.partition("'")
    capitals = token.strip("'").partition("'")[0]
    spelled = capitals.isupper() and 2 <= len(stem) <= LONGEST_ACRONYM and stem not in known
    if spelled and stem.isascii():
        yield from stem[:-1]
        yield stem[-1] + apostrophe + ending
    elif word:
        yield word


def _plain(word: str) -> str:
    """Return `word` in lower case without accents."""
    letters = unicodedata.normalize("NFD", word.lower())
    return "".join(c for c in letters if not unicodedata.combining(c))


def _number(digits: str) -> list[str]:
    """Return the words of a plain decimal number such as 1,250.75 or, as a year, 1984."""
    whole, _, fraction = digits.partition(".")
    value = int(whole.replace(",", ""))
    if value >= 1000 ** len(_THOUSANDS) or (whole[0] == "0" and len(whole) > 1):
        words = [_UNITS[int(d)] for d in whole if d.isdecimal()]
    elif len(whole) == 4 and (1100 <= value < 2000 or 2010 <= value < 2100) and not fraction:
        words = _cardinal(value // 100) + _last_of_year(value % 100)
    else:
        words = _cardinal(value)
    return words + (["point"] + [_UNITS[int(d)] for d in fraction] if fraction else [])


def _last_of_year(value: int) -> list[str]:
    if value == 0:
        return ["hundred"]
    return (["oh"] if value < 10 else []) + _cardinal(value)


def _cardinal(value: int) -> list[str]:
    if value < 20:
        return [_UNITS[value]]
    if value < 100:
        return [_TENS[value // 10]] + (_cardinal(value % 10) if value % 10 else [])
    if value < 1000:
        rest = _cardinal(value % 100) if value % 100 else []
        return [_UNITS[value // 100], "hundred", *rest]
    power = next(p for p in range(len(_THOUSANDS) - 1, 0, -1) if value >= 1000**p)
    rest = _cardinal(value % 1000**power) if value % 1000**power else []
    return [*_cardinal(value // 1000**power), _THOUSANDS[power], *rest]


def _ended(words: list[str], ending: str) -> list[str]:
    """Return the number `words` as an ordinal (ending th and so on) or a decade (ending s)."""
    if not ending:
        return words
    last = words[-1]
    if ending.endswith("s"):
        return [*words[:-1], last[:-1] + "ies" if last.endswith("y") else last + "s"]
    ordinal = last[:-1] + "ieth" if last.endswith("y") else last + "th"
    return [*words[:-1], _ORDINALS.get(last, ordinal)]


@lru_cache(maxsize=1)
def dictionary() -> Mapping[str, tuple[str, ...]]:
    """Return CMUdict: lower-case word -> phones of its first pronunciation.

    Raises:
        InputError: pocketsphinx, whose wheel carries it, is not installed.
    """
    return MappingProxyType({word: first for word, (first, *_) in _cmudict().items()})


@lru_cache(maxsize=1)
def _cmudict() -> Lexicon:
    try:
        import pocketsphinx
    except ImportError as error:
        raise InputError(
            "pronunciations need pocketsphinx's dictionary; run pip install 'mmmgpu[align]'"
        ) from error
    return read_lexicon(pocketsphinx.get_model_path("en-us/cmudict-en-us.dict"))


def look_up_english(text: str) -> list[Spoken]:
    """Return the words of `text` (see `spoken_words`) with all pronunciations that CMUdict has.

    Of a word that it has not, the one of `pronounce`.
    """
    known = _cmudict()
    return [(w, known.get(_plain(w)) or (pronounce(w),)) for w in spoken_words(text)]


@lru_cache(maxsize=10_000)
def pronounce(word: str) -> tuple[str, ...]:
    """Return the phones of one spoken word (see `spoken_words`), at least one.

    Raises:
        InputError: The word has no Latin letter, or pocketsphinx is not installed.
    """
    plain = _plain(word)
    if plain in dictionary():
        return dictionary()[plain]
    if not re.search("[a-z]", plain):
        raise InputError(f"cannot tell how {word!r} is said; write it in Latin letters")
    stem, _, ending = plain.rpartition("'")
    if ending == "s" and stem in dictionary():
        return dictionary()[stem] + _plural(dictionary()[stem][-1])
    return _from_espeak(plain) or from_letters(plain)


def letter_name(letter: str) -> tuple[str, ...]:
    """Return the phones of the name of one letter (A is EY)."""
    name = _LETTER_NAMES.get(_plain(letter))
    return tuple(name.split()) if name else pronounce(letter)


def from_letters(word: str) -> tuple[str, ...]:
    """Return a rough pronunciation of a word by the commonest sound of its letters."""
    letters = re.sub("[^a-z]", "", _plain(word))
    letters = re.sub(r"(.)\1(?<![eo]{2})", r"\1", letters)  # double consonants
    letters = re.sub(r"(?<=[aeiouy][^aeiouy])e$", "", letters)  # silent e
    phones: list[str] = []
    i = 0
    while i < len(letters):
        spelling = next(
            letters[i : i + n] for n in (4, 3, 2, 1) if letters[i : i + n] in _LETTER_RULES
        )
        phones += _LETTER_RULES[spelling].split()
        i += len(spelling)
    return tuple(phones)


def _plural(last: str) -> tuple[str, ...]:
    if last in ("S", "Z", "SH", "ZH", "CH", "JH"):
        return ("IH", "Z")
    return ("S",) if last in ("P", "T", "K", "F", "TH") else ("Z",)


def _from_espeak(word: str) -> tuple[str, ...]:
    """Return what espeak-ng says, () where it is not installed."""
    from mmmgpu.voices import is_installed, transcribe

    return transcribe(word) if is_installed() else ()
