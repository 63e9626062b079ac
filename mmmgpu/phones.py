# ruff: noqa: RUF001 (IPA letters look like Latin ones)
"""Phones as data: the inventory, what each looks like, and which may stand in for which.

Labels are ARPAbet without stress digits, plus SIL and those of CE05 (AX AXR DX IX BR). Nothing here
knows about sound or time. The nine classes are those of CE05 section 5.2; the table of visible
articulation is ours: rough values in [0, 1], made to rank look-alikes and for nothing else.
"""

import math
import re
import unicodedata
from collections.abc import Set as AbstractSet
from types import MappingProxyType
from typing import Final

SIL: Final = "SIL"

# CE05 section 5.2: the regression classes of its 40 phones, in the paper's order.
CE05_CLASSES: Final[tuple[tuple[str, ...], ...]] = (
    ("AO", "W"),
    ("AA", "AE", "AH", "AX", "EH", "HH", "BR"),
    ("B", "M", "P"),
    ("F", "V"),
    ("AXR", "D", "DH", "K", "S", "T", "TH", "Z"),
    ("DX", "G", "IH", "IX", "IY", "N", "NG", "Y"),
    ("ER", "L", "R", "UH"),
    ("CH", "JH", "SH", "UW", "ZH"),
    ("SIL",),
)

CE05_PHONES: Final = tuple(phone for phones in CE05_CLASSES for phone in phones)

# CMUdict's five that CE05 lacks: (nucleus, glide); the nucleus takes NUCLEUS_SHARE of the time.
DIPHTHONGS: Final = MappingProxyType(
    {
        "AW": ("AA", "UH"),
        "AY": ("AA", "IY"),
        "EY": ("EH", "IY"),
        "OW": ("AO", "UH"),
        "OY": ("AO", "IY"),
    }
)
NUCLEUS_SHARE: Final = 0.6

# Phones that a lip reader confuses.
VISEMES: Final = MappingProxyType(
    {
        "rest": ("SIL",),
        "lips": ("B", "M", "P"),
        "lip and teeth": ("F", "V"),
        "tongue and teeth": ("DH", "TH"),
        "tongue tip": ("D", "DX", "L", "N", "T"),
        "sibilant": ("S", "Z"),
        "rounded sibilant": ("CH", "JH", "SH", "ZH"),
        "back": ("BR", "G", "HH", "K", "NG"),
        "r": ("AXR", "ER", "R"),
        "rounded": ("UH", "UW", "W"),
        "half rounded": ("AO", "OW", "OY"),
        "open": ("AA", "AW", "AY"),
        "neutral": ("AH", "AX"),
        "half spread": ("AE", "EH", "EY"),
        "spread": ("IH", "IX", "IY", "Y"),
    }
)

FEATURES: Final = ("closure", "labiodental", "rounding", "spread", "opening", "tongue", "teeth")
# fmt: off
_SHAPES: Final[dict[str, tuple[float, ...]]] = {
    # label  closure labiod. round. spread opening tongue teeth
    "SIL":  (0.90, 0.00, 0.00, 0.30, 0.00, 0.00, 0.20),
    "BR":   (0.00, 0.00, 0.00, 0.30, 0.40, 0.00, 0.00),
    "B":    (1.00, 0.00, 0.00, 0.20, 0.00, 0.00, 0.20),
    "M":    (1.00, 0.00, 0.00, 0.25, 0.00, 0.00, 0.20),
    "P":    (1.00, 0.00, 0.00, 0.20, 0.00, 0.00, 0.25),
    "F":    (0.20, 1.00, 0.00, 0.30, 0.10, 0.00, 0.40),
    "V":    (0.20, 1.00, 0.00, 0.30, 0.15, 0.00, 0.40),
    "TH":   (0.00, 0.00, 0.00, 0.30, 0.25, 1.00, 0.50),
    "DH":   (0.00, 0.00, 0.00, 0.30, 0.30, 1.00, 0.45),
    "T":    (0.00, 0.00, 0.00, 0.40, 0.20, 0.50, 0.70),
    "D":    (0.00, 0.00, 0.00, 0.40, 0.22, 0.50, 0.65),
    "N":    (0.00, 0.00, 0.00, 0.40, 0.25, 0.55, 0.60),
    "DX":   (0.00, 0.00, 0.00, 0.40, 0.30, 0.50, 0.45),
    "L":    (0.00, 0.00, 0.10, 0.30, 0.35, 0.75, 0.30),
    "S":    (0.00, 0.00, 0.00, 0.55, 0.15, 0.20, 1.00),
    "Z":    (0.00, 0.00, 0.00, 0.55, 0.17, 0.20, 0.95),
    "SH":   (0.00, 0.00, 0.65, 0.00, 0.22, 0.10, 0.90),
    "ZH":   (0.00, 0.00, 0.65, 0.00, 0.24, 0.10, 0.85),
    "CH":   (0.00, 0.00, 0.60, 0.05, 0.20, 0.20, 0.95),
    "JH":   (0.00, 0.00, 0.60, 0.05, 0.22, 0.20, 0.90),
    "K":    (0.00, 0.00, 0.00, 0.35, 0.35, 0.10, 0.30),
    "G":    (0.00, 0.00, 0.00, 0.35, 0.37, 0.10, 0.27),
    "NG":   (0.00, 0.00, 0.00, 0.40, 0.37, 0.15, 0.27),
    "HH":   (0.00, 0.00, 0.00, 0.30, 0.45, 0.00, 0.10),
    "R":    (0.00, 0.00, 0.55, 0.05, 0.25, 0.10, 0.40),
    "ER":   (0.00, 0.00, 0.50, 0.10, 0.35, 0.10, 0.30),
    "AXR":  (0.00, 0.00, 0.40, 0.15, 0.35, 0.10, 0.30),
    "W":    (0.10, 0.00, 1.00, 0.00, 0.10, 0.00, 0.00),
    "UW":   (0.00, 0.00, 0.95, 0.00, 0.20, 0.00, 0.00),
    "UH":   (0.00, 0.00, 0.60, 0.10, 0.35, 0.00, 0.10),
    "AO":   (0.00, 0.00, 0.55, 0.05, 0.75, 0.00, 0.00),
    "AA":   (0.00, 0.00, 0.05, 0.20, 1.00, 0.10, 0.00),
    "AH":   (0.00, 0.00, 0.00, 0.30, 0.60, 0.05, 0.10),
    "AX":   (0.00, 0.00, 0.00, 0.30, 0.45, 0.05, 0.20),
    "AE":   (0.00, 0.00, 0.00, 0.60, 0.90, 0.15, 0.20),
    "EH":   (0.00, 0.00, 0.00, 0.60, 0.65, 0.15, 0.25),
    "IH":   (0.00, 0.00, 0.00, 0.65, 0.40, 0.15, 0.45),
    "IX":   (0.00, 0.00, 0.00, 0.55, 0.38, 0.10, 0.45),
    "IY":   (0.00, 0.00, 0.00, 1.00, 0.30, 0.20, 0.60),
    "Y":    (0.00, 0.00, 0.05, 0.85, 0.27, 0.20, 0.60),
}
# fmt: on
for _label, (_nucleus, _glide) in DIPHTHONGS.items():
    _SHAPES[_label] = tuple(
        NUCLEUS_SHARE * a + (1 - NUCLEUS_SHARE) * b
        for a, b in zip(_SHAPES[_nucleus], _SHAPES[_glide], strict=True)
    )

PHONES: Final = frozenset(_SHAPES)
CMU_PHONES: Final = PHONES - {"AX", "AXR", "BR", "DX", "IX"}  # CMUdict's 39 and SIL
VOWELS: Final = frozenset(DIPHTHONGS) | frozenset(
    ("AA", "AE", "AH", "AO", "AX", "AXR", "EH", "ER", "IH", "IX", "IY", "UH", "UW")
)
_VISEME_OF: Final = {label: name for name, labels in VISEMES.items() for label in labels}
_SILENT: Final = frozenset(
    ("", "sil", "sp", "spn", "nsn", "pau", "h#", "#", "<sil>", "<s>", "</s>", "<p>", "<eps>")
)

# Nearest phones of CMUdict for an IPA symbol, any language; two letters win over one.
_IPA: Final[dict[str, tuple[str, ...]]] = {
    symbol: tuple(labels.split())
    for labels, symbols in (
        ("AA", "ɑ a ɒ"),
        ("AE", "æ"),
        ("AH", "ʌ ɐ ə ɘ"),
        ("ER", "ɚ ɜ ɝ ɞ"),
        ("AO", "ɔ o ɤ ɶ"),
        ("EH", "ɛ e œ"),
        ("IH", "ɪ ᵻ ɨ"),
        ("IY", "i"),
        ("UH", "ʊ ɵ"),
        ("UW", "u ʉ y ʏ ø ɯ"),
        ("AW", "aʊ au aw"),
        ("AY", "aɪ ai aj ɑɪ"),
        ("EY", "eɪ ei ej ɛɪ"),
        ("OW", "oʊ əʊ ou ow ɔʊ"),
        ("OY", "ɔɪ oɪ oi ɔi ɔj oj"),
        ("B", "b ɓ ʙ"),
        ("CH", "tʃ tɕ ʈʂ cç"),
        ("D", "d ɖ ɗ"),
        ("DH", "ð"),
        ("F", "f ɸ"),
        ("G", "g ɡ ɢ ʛ ɠ ɣ"),
        ("HH", "h ɦ ħ ʜ x χ ɧ ʕ"),
        ("JH", "dʒ dʑ ɖʐ ɟ ʄ"),
        ("K", "k q c"),
        ("L", "l ɫ ɭ ʎ ɬ ɮ ʟ ɺ"),
        ("M", "m ɱ"),
        ("N", "n ɲ ɳ"),
        ("NG", "ŋ ɴ"),
        ("P", "p"),
        ("R", "r ɹ ɻ ʀ ʁ"),
        ("S", "s"),
        ("SH", "ʃ ɕ ʂ ç"),
        ("T", "t ʈ ɾ ɽ"),
        ("T S", "ts"),
        ("D Z", "dz"),
        ("TH", "θ"),
        ("V", "v ʋ β ⱱ"),
        ("W", "w ʍ ɥ ɰ"),
        ("Y", "j ʝ"),
        ("Z", "z"),
        ("ZH", "ʒ ʑ ʐ"),
        ("", "ʔ ʡ"),  # a glottal stop does not show
    )
    for symbol in symbols.split()
}


def normalise_label(label: str) -> str:
    """Return `label` as a model keeps it: silences become SIL, stress digits go, the rest stays.

    >>> [normalise_label(label) for label in ("", "spn", "AH0", "ih1", "ɲ")]
    ['SIL', 'SIL', 'AH', 'ih', 'ɲ']
    """
    label = label.strip()
    if label.lower() in _SILENT:
        return SIL
    if label[-1] in "012" and label[:-1].upper() in VOWELS:
        return label[:-1]
    return label


def from_ipa(text: str) -> tuple[str, ...]:
    """Return the nearest phones of CMUdict to an IPA string; stress, length and tone are dropped.

    Symbols that are no IPA letters are passed over, so the answer may be empty.
    """
    letters = _ipa_letters(text)
    labels: list[str] = []
    i = 0
    while i < len(letters):
        width = 2 if letters[i : i + 2] in _IPA else 1
        labels += _IPA.get(letters[i : i + width], ())
        i += width
    return tuple(labels)


def _ipa_letters(text: str) -> str:
    """Return the letters of `text` without diacritics and modifiers, but keep those like ç."""
    bare = (
        c if c in _IPA else unicodedata.normalize("NFD", c)[0]
        for c in unicodedata.normalize("NFC", text)
    )
    return "".join(c for c in bare if unicodedata.category(c) in ("Ll", "Lo"))


def arpabet(label: str) -> str | None:
    """Return the phone of `PHONES` that `label` means (any case, stressed, or IPA), or None.

    Of an IPA symbol that is two phones (ts), the first.
    """
    label = normalise_label(label)
    if label.upper() in PHONES:
        return label.upper()
    return next(iter(_IPA.get(_ipa_letters(label), ())), None)


def ce05_class(label: str) -> int:
    """Return the index in `CE05_CLASSES` of `label`; a diphthong goes with its nucleus.

    A label that is not of the inventory takes the class of its nearest phone (see `stand_in`).
    """
    class_of = {phone: i for i, phones in enumerate(CE05_CLASSES) for phone in phones}
    return class_of[stand_in(ce05_phone(label), class_of.keys())]


def ce05_phone(label: str) -> str:
    """Return `label` as CE05 has it: a diphthong as its nucleus, all else as it is."""
    label = arpabet(label) or label
    return DIPHTHONGS.get(label, (label,))[0]


def look_alike_distance(a: str, b: str) -> float:
    """Return the Euclidean distance of two of `PHONES` in the table of `FEATURES`."""
    return math.dist(_SHAPES[a], _SHAPES[b])


def stand_in(label: str, known: AbstractSet[str]) -> str:
    """Return the label of `known` that looks most like `label`; `label` itself if it is known.

    A phone of the same viseme class comes first, then the nearest in visible articulation, then the
    first by name, so the answer never depends on the order of `known`. SIL stands in for speech
    only when nothing else is known. A label that means no phone is speech of unknown kind and is
    treated as the neutral vowel AX, unless it is in brackets (`<unk>`, `[noise]`): that is SIL.
    Callers warn once per label.
    """
    if label in known:
        return label
    if not known:
        raise ValueError("known must hold at least one label")
    wanted = arpabet(label) or (SIL if re.match(r"[<\[{(+]", label) else "AX")

    def unlikeness(candidate: str) -> tuple[bool, bool, bool, float, str]:
        phone = arpabet(candidate)
        if phone is None:
            return (True, True, True, 0.0, candidate)
        return (
            False,
            phone == SIL and wanted != SIL,
            _VISEME_OF[phone] != _VISEME_OF[wanted],
            look_alike_distance(phone, wanted),
            candidate,
        )

    return min(known, key=unlikeness)
