import pytest

from mmmgpu.errors import InputError
from mmmgpu.lexicons import look_up, read_lexicon

TEXT = """\
;;; a comment, as in CMUdict 0.7
# and as in others
HELLO  HH AH0 L OW1
hello(2)\tHH EH0 L OW1 # British
hello(3) HH AH1 L OW0
Straße S t r a: s @
don't D OW1 N T
e-mail IY1 M EY2 L
mail M EY1 L
a.m. EY1 EH2 M
A EY1

'em AH0 M
2 T UW1
हिन्दी h i n d i:
"""


@pytest.fixture
def lexicon(tmp_path):
    (tmp_path / "words.dict").write_text(TEXT, encoding="utf-8")
    return read_lexicon(tmp_path / "words.dict")


def test_words_and_their_pronunciations(lexicon):
    assert lexicon["hello"] == (("HH", "AH", "L", "OW"), ("HH", "EH", "L", "OW"))
    assert lexicon["straße"] == (("S", "t", "r", "a:", "s", "@"),)
    assert set(lexicon) == {
        *("hello", "straße", "don't", "e-mail", "mail", "a.m.", "a", "'em", "2", "हिन्दी"),
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Hello, “HELLO” — hello!", "hello hello hello"),
        ("Don\u2019t e-mail 'em.", "don't e-mail 'em"),
        ("A 'e-mail' \u2018em, 2 A.M.", "a e-mail 'em 2 a.m."),
        ("हिन्दी! हिन्दी-mail", "हिन्दी हिन्दी mail"),
        ("mail-mail/2", "mail mail 2"),
        ("STRASSE", None),
        ("Stra\u00dfe हिन्दी (2)", "straße हिन्दी 2"),
        (" ... ", ""),
    ],
)
def test_words_of_a_text(lexicon, text, words):
    if words is None:
        with pytest.raises(InputError, match=r"'strasse' is not in the dictionary a\.dict; add it"):
            look_up(text, lexicon, "a.dict")
        return
    found = look_up(text, lexicon, "a.dict")
    assert " ".join(w for w, _ in found) == words
    assert all(said == lexicon[w] for w, said in found)


def test_accents_may_be_written_either_way(tmp_path):
    (tmp_path / "a").write_text("cafe\u0301 K AH F EY", encoding="utf-8")
    assert look_up("CAF\u00c9", read_lexicon(tmp_path / "a"), "a")[0][0] == "caf\u00e9"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"hello HH AH\nlonely\n",
            r"a\.dict:2: expected 'word PHONE PHONE \.\.\.', found 'lonely'",
        ),
        (b"hello 0.99 HH AH\n", r"a\.dict:1: expected 'word PHONE PHONE \.\.\.'"),
        (b"\xff\xfe\x00", r"a\.dict: is not text in UTF-8"),
        (b";;; nothing\n\n", r"a\.dict: holds no word"),
        (None, r"a\.dict: cannot be read"),
    ],
)
def test_a_file_that_is_no_dictionary(tmp_path, content, message):
    if content is not None:
        (tmp_path / "a.dict").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_lexicon(tmp_path / "a.dict")
