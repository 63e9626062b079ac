from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmmgpu.errors import InputError
from mmmgpu.textgrid import format_textgrid, parse_textgrid

HERE = Path("some.TextGrid")
SHORT = """File type = "ooTextFile"
Object class = "TextGrid"

0
1.5
<exists>
3
"IntervalTier"
"phones"
0
1.5
2
0
0.5
""
0.5
1.5
"say ""ah"" ! 7"
"TextTier"
"bells"
0
1.5
1
0.7
"ding"
"IntervalTier"
"empty"
0
1.5
0
"""
LABELS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\0"), max_size=8)


def test_short_format_quotes_and_point_tiers():
    duration, tiers = parse_textgrid(SHORT, HERE)
    assert duration == 1.5
    assert [tier.name for tier in tiers] == ["phones", "empty"]
    assert tiers[0].rows == [("", 0.0, 0.5, 15), ('say "ah" ! 7', 0.5, 1.5, 18)]
    assert tiers[1].rows == []


@given(st.lists(st.tuples(LABELS, st.floats(1e-3, 1e3)), min_size=1, max_size=9), LABELS)
def test_what_is_written_is_read_back_exactly(pairs, name):
    rows, now = [], 0.0
    for label, length in pairs:
        rows.append((label, now, now + length))
        now += length
    duration, tiers = parse_textgrid(format_textgrid([(name, rows), ("again", rows)]), HERE)
    assert duration == now
    assert [tier.name for tier in tiers] == [name, "again"]
    assert all([row[:3] for row in tier.rows] == rows for tier in tiers)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ooTextFile", "ooBinaryFile", "some.TextGrid: is not a Praat TextGrid text file"),
        ('"TextGrid"', '"Sound"', "is not a Praat TextGrid text file"),
        ("<exists>\n3", "<exists>\nthree", "TextGrid:8: expected a number .the number of tiers"),
        ("<exists>\n3", "<exists>\n2.5", "TextGrid:7: expected a whole number"),
        ("1.5\n2\n", "1.5\n-2\n", "TextGrid:12: expected a whole number"),
        ('0.5\n""', "0.5\n0.6", "TextGrid:15: expected a quoted text .text., found '0.6'"),
        ('0.5\n""', "0.5\n", "TextGrid:16: expected a quoted text"),
        ("1.5\n0\n", "1.5\n1\n", "TextGrid:30: truncated, ends before xmin"),
    ],
)
def test_a_fault_names_the_file_and_the_line(old, new, message):
    assert old in SHORT
    with pytest.raises(InputError, match=message):
        parse_textgrid(SHORT.replace(old, new), HERE)


def test_an_unclosed_quote_is_a_truncation():
    with pytest.raises(InputError, match="truncated"):
        parse_textgrid(SHORT[: SHORT.index("say") + 2], HERE)
