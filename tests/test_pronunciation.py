import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmmgpu import pronunciation, voices
from mmmgpu.errors import InputError
from mmmgpu.phones import CMU_PHONES, SIL
from mmmgpu.pronunciation import (
    dictionary,
    from_letters,
    letter_name,
    look_up_english,
    pronounce,
    spoken_words,
)


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("Hello, world!", "hello world"),
        ("don\u2019t \u201cquote\u201d 'cause it's Bob's", "don't quote 'cause it's bob's"),
        ("twenty-one e-mails \u2014 now", "twenty one e mails now"),
        ("the U.S. and B. P. and the XKCD's NASA", "the u s and b p and the x k c d's nasa"),
        ("IT IS SHOUTED", "it is shouted"),
        ("café naïve", "cafe naive"),
        ("0 7 13 20 45 100 115", "zero seven thirteen twenty forty five one hundred "
         "one hundred fifteen"),
        ("1,001 2000 12345", "one thousand one two thousand twelve thousand three hundred forty "
         "five"),
        ("1984 1905 1900 2015 2005", "nineteen eighty four nineteen oh five nineteen hundred "
         "twenty fifteen two thousand five"),
        ("3.14 007", "three point one four zero zero seven"),
        ("1st 2nd 3rd 12th 20th 45th 100th", "first second third twelfth twentieth forty fifth "
         "one hundredth"),
        ("the 1990s and '60s", "the nineteen nineties and sixties"),
        ("$5 & 3.5% of £1,000", "five dollars and three point five percent of one thousand pounds"),
        ("mp3 x2", "mp three x two"),
        ("1" + "0" * 15, "one" + " zero" * 15),
        (" ... \u2014 !", ""),
    ],
)  # fmt: skip
def test_text_as_it_is_said(text, want):
    assert " ".join(spoken_words(text)) == want


def value_of(words):
    """Undo `spoken_words` for cardinals, by another way: accumulate."""
    units = {w: i for i, w in enumerate(pronunciation._UNITS)}
    tens = {w: 10 * i for i, w in enumerate(pronunciation._TENS) if w}
    total = group = 0
    for word in words:
        if word == "hundred":
            group *= 100
        elif word in pronunciation._THOUSANDS:
            total += group * 1000 ** pronunciation._THOUSANDS.index(word)
            group = 0
        else:
            group += units.get(word, 0) + tens.get(word, 0)
    return total + group


@given(st.integers(0, 10**15 - 1))
def test_numbers_mean_what_they_say(number):
    assert value_of(spoken_words(f"{number:,}")) == number


@given(st.text(max_size=30))
def test_any_text_gives_lower_case_words_without_spaces(text):
    for word in spoken_words(text):
        assert word == word.lower()
        assert word.split() == [word]


def test_the_dictionary_has_no_stress_and_no_alternatives():
    assert len(dictionary()) > 120_000
    assert dictionary()["hello"] == ("HH", "AH", "L", "OW")
    assert not [word for word in dictionary() if "(" in word]
    assert {p for phones in dictionary().values() for p in phones} == CMU_PHONES - {SIL}


@pytest.mark.parametrize(
    ("word", "want"),
    [
        ("hello", "HH AH L OW"),
        ("CAFÉ", "K AH F EY"),
        ("barack's", "B AA R AH K S"),
        ("couch's", "K AW CH IH Z"),
        ("giraffes's", "JH ER AE F S IH Z"),
        ("noises's", "N OY Z IH Z IH Z"),
    ],
)
def test_words_and_their_possessives(word, want):
    assert " ".join(pronounce(word)) == want


@pytest.mark.parametrize("word", ["kubernetes", "glorptastic", "zqx", "mmm", "o'neilly"])
@pytest.mark.parametrize("installed", [True, False])
def test_words_that_are_in_no_dictionary(monkeypatch, word, installed):
    monkeypatch.setattr(voices, "is_installed", lambda: installed)
    pronounce.cache_clear()
    assert word not in dictionary()
    phones = pronounce(word)
    pronounce.cache_clear()
    assert phones
    assert installed or phones == from_letters(word)
    assert set(phones) <= CMU_PHONES - {SIL}


def test_espeak_knows_better_than_letters():
    assert pronounce("kubernetes")[:6] == ("K", "UW", "B", "ER", "N", "EH")


@pytest.mark.parametrize(
    ("word", "want"),
    [
        ("ship", "SH IH P"),
        ("night", "N AY T"),
        ("make", "M AE K"),
        ("see", "S IY"),
        ("hammer", "HH AE M ER"),
        ("nation", "N AE SH AH N"),
        ("quack", "K W AE K"),
    ],
)
def test_letter_rules(word, want):
    assert " ".join(from_letters(word)) == want


@given(st.text("abcdefghijklmnopqrstuvwxyz'", min_size=1, max_size=12))
def test_every_spelling_has_phones(word):
    phones = from_letters(word)
    assert set(phones) <= CMU_PHONES - {SIL}
    assert bool(phones) == bool(word.strip("'"))


def test_letter_names():
    assert [letter_name(c)[0] for c in "aAéz"] == ["EY", "EY", "IY", "Z"]


def test_what_cannot_be_said_is_named():
    with pytest.raises(InputError, match="cannot tell how 'мир' is said"):
        pronounce("мир")


def test_a_missing_extra_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pocketsphinx", None)
    dictionary.cache_clear()
    pronunciation._cmudict.cache_clear()
    with pytest.raises(InputError, match=r"pip install 'mmmgpu\[align\]'"):
        dictionary()


def test_english_words_come_with_all_their_pronunciations():
    assert look_up_english("Read a glorbo!") == [
        ("read", (("R", "EH", "D"), ("R", "IY", "D"))),
        ("a", (("AH",), ("EY",))),
        ("glorbo", (pronounce("glorbo"),)),
    ]
