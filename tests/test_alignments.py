# ruff: noqa: RUF001 (IPA letters look like Latin ones)
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmmgpu.alignments import (
    Alignment,
    Segment,
    check_against,
    cover,
    find_alignment,
    frame_labels,
    read_alignment,
    shift,
    spread,
    write_textgrid,
)
from mmmgpu.errors import InputError
from mmmgpu.phones import SIL

BIN = Alignment(
    phones=(
        Segment(SIL, 0.0, 0.7),
        Segment("B", 0.7, 0.75),
        Segment("IH", 0.75, 0.8),
        Segment("N", 0.8, 0.88),
        Segment(SIL, 0.88, 1.0),
    ),
    words=(Segment("bin", 0.7, 0.88),),
    duration=1.0,
)


@st.composite
def alignments(draw):
    """Alignments as the readers make them: phones cover the clip, no SIL beside another."""
    labels = st.sampled_from(["AA", "B", "ɲ", 'a"b', SIL])
    lengths = draw(st.lists(st.floats(0.001, 2.0), min_size=1, max_size=12))
    times = np.cumsum([0.0, *lengths]).tolist()
    phones = [Segment(draw(labels), *pair) for pair in itertools.pairwise(times)]
    words = [p._replace(label="word") for p in phones if draw(st.booleans())]
    return Alignment(cover(phones, times[-1]), tuple(words), times[-1])


def grid_of(alignment, tmp_path, name="a.TextGrid"):
    write_textgrid(alignment, tmp_path / name)
    return (tmp_path / name).read_text(encoding="utf-8")


# Reading and writing


@given(alignment=alignments())
@settings(max_examples=60)
def test_what_is_written_is_read_back_exactly(tmp_path_factory, alignment):
    path = tmp_path_factory.mktemp("round") / "with space é.TextGrid"
    write_textgrid(alignment, path)
    assert read_alignment(path) == alignment
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encodings_and_line_ends_of_praat(tmp_path, encoding, newline):
    text = grid_of(BIN, tmp_path).replace("IH", "ɪ").replace("\n", newline)
    bom = b"\xfe\xff" if encoding == "utf-16-be" else b""
    (tmp_path / "b.TextGrid").write_bytes(bom + text.encode(encoding))
    assert [p.label for p in read_alignment(tmp_path / "b.TextGrid").phones][1:4] == ["B", "ɪ", "N"]


def test_tiers_of_the_montreal_aligner_in_any_order_with_stress_and_silences(tmp_path):
    text = grid_of(BIN, tmp_path).replace('"IH"', '"IH1"').replace('"SIL"', '"spn"', 1)
    text = text.replace('name = "words"', 'name = "Ann Lee - Words"')
    text = text.replace('name = "phones"', 'name = "Ann Lee - PHONES"')
    (tmp_path / "b.TextGrid").write_text(text)
    assert read_alignment(tmp_path / "b.TextGrid") == BIN


def test_gaps_become_silence_and_rounding_is_closed(tmp_path):
    (tmp_path / "a.lab").write_text("0.5 0.60001 b\n0.6 0.7 AA1\n0.70002 0.8 t\n0.9 1.0 sil\n")
    a = read_alignment(tmp_path / "a.lab")
    assert [p.label for p in a.phones] == [SIL, "b", "AA", "t", SIL]
    np.testing.assert_allclose(
        [p.end for p in a.phones], [0.5, 0.60001, 0.7, 0.8, 1.0], rtol=0, atol=1e-12
    )
    assert all(x.end == y.start for x, y in zip(a.phones, a.phones[1:], strict=False))


def test_grid_words_become_phones_and_single_letters_are_letters(tmp_path):
    (tmp_path / "bbaf3s.align").write_text("0 25000 sil\n25000 37500 bin\n37500 50000 a\n")
    a = read_alignment(tmp_path / "bbaf3s.align")
    assert a.words == (Segment("bin", 1.0, 1.5), Segment("a", 1.5, 2.0))
    assert [p.label for p in a.phones] == [SIL, "B", "IH", "N", "EY"]
    np.testing.assert_allclose([p.end for p in a.phones], [1, 1.125, 1.375, 1.5, 2], rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "0 7000000 sil\n7000000 7500000 x^x-B+IH=N@1\n7500000 8000000 B-IH+N\n"
        "8000000 8800000 IH-N\n8800000 10000000 pau\n",
        "0.0 0.7 sil\n0.7 0.75 B -12.5 bin\n0.75 0.8 IH -1\n0.8 0.88 N\n0.88 1.0 sil 0 sil\n",
    ],
)
def test_htk_in_both_units_with_triphones_scores_and_words(tmp_path, text):
    (tmp_path / "a.lab").write_text(text)
    a = read_alignment(tmp_path / "a.lab")
    assert [p.label for p in a.phones] == [SIL, "B", "IH", "N", SIL]
    np.testing.assert_allclose(
        [p[1:] for p in a.phones], [p[1:] for p in BIN.phones], rtol=0, atol=1e-12
    )
    assert a.words == (() if "pau" in text else BIN.words)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.TextGrid", b"", "a.TextGrid: is empty"),
        ("a.lab", b" \n", "a.lab: is empty"),
        ("a.lab", b"#\n", "a.lab: holds no segments"),
        ("a.txt", b"0 1 sil", "a.txt: is no alignment; give one of .TextGrid"),
        ("a.TextGrid", bytes(range(256)) * 9, "a.TextGrid: is not text in UTF-8 or UTF-16"),
        ("a.lab", b"\xff\xfe\x00", "a.lab: is not text in UTF-8 or UTF-16"),
        ("a.lab", b"0\x00 1 a", "a.lab: is not a text file"),
        ("a.lab", b"0.0 0.5 a\n0.5 b 0.7\n", "a.lab:2: expected 'start end label'"),
        ("a.lab", b"0.0 0.5 a\n0.4 0.7 b\n", "a.lab:2: .'b', 0.4 to 0.7 s. overlaps"),
        ("a.lab", b"0.0 0.5 a\n\n0.7 0.6 b\n", "a.lab:3: .'b', 0.7 to 0.6 s. ends before"),
        ("a.lab", b"0.0 0.5 a\n0.5 0.5 b\n", "a.lab:2: .'b', 0.5 to 0.5 s. has no length"),
        ("a.lab", b"0.0 nan a\n0.5 0.6 b\n", "a.lab:1: .'a', 0 to nan s. has a time that is no"),
        ("a.lab", b"0.0 inf a\n", "a.lab:1: .'a', 0 to inf s. has a time that is no"),
        ("a.lab", b"-0.1 0.5 a\n", "a.lab:1: .'a', -0.1 to 0.5 s. starts before 0 s"),
        ("a.align", b"0 10 bin\n10 5 blue\n", "a.align:2: .'blue', .* ends before it starts"),
        ("a.align", "0 10 ничего\n".encode(), "Latin letters"),
    ],
)
def test_a_bad_file_is_one_line_with_path_and_line(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_alignment(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("xmax = 0.75", "xmax = 0.76", "overlaps what comes before"),
        ("xmax = 1.0\n", "xmax = 0.9\n", "after the end of the alignment .0.9 s."),
        ("xmax = 1.0\n", "xmax = nan\n", "the end time must be > 0 s"),
        ('"phones"', '"segments"', "has no interval tier named 'phones' .it has 'words', 'segm"),
        ('"words"', '"phones"', "has 2 tiers named 'phones'"),
        ("xmin = 0.8\n", "xmin = xmax\n", "expected"),
    ],
)
def test_a_bad_textgrid_is_one_line_with_the_path(tmp_path, old, new, message):
    text = grid_of(BIN, tmp_path)
    assert old in text
    (tmp_path / "b.TextGrid").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=f"b.TextGrid.*{message}"):
        read_alignment(tmp_path / "b.TextGrid")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match=r"no\.lab: cannot be read"):
        read_alignment(tmp_path / "no.lab")
    (tmp_path / "dir.lab").mkdir()
    with pytest.raises(InputError, match=r"dir\.lab: cannot be read"):
        read_alignment(tmp_path / "dir.lab")


def test_every_truncation_is_an_alignment_or_an_input_error(tmp_path):
    text = grid_of(BIN, tmp_path)
    rng = np.random.default_rng(0)
    refused = 0
    for cut in rng.integers(0, len(text), 150):
        (tmp_path / "b.TextGrid").write_text(text[:cut])
        with pytest.raises(InputError):
            read_alignment(tmp_path / "b.TextGrid")
        refused += 1
    assert refused == 150


@given(data=st.data())
@settings(max_examples=150)
def test_damaged_files_are_alignments_or_input_errors(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    suffix = data.draw(st.sampled_from([".TextGrid", ".align", ".lab"]))
    text = grid_of(BIN, folder) if suffix == ".TextGrid" else "0 7 sil\n7 12 bin\n12 20 SIL\n"
    good = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(good) - 1))
        good[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path = folder / f"b{suffix}"
    path.write_bytes(good)
    try:
        message = repr(read_alignment(path))
    except InputError as error:
        message = str(error)
    assert "\n" not in message


def test_a_folder_that_is_not_there_cannot_be_written_to(tmp_path):
    with pytest.raises(InputError, match="the folder does not exist"):
        write_textgrid(BIN, tmp_path / "none" / "a.TextGrid")
    assert list(tmp_path.iterdir()) == []


# The record


@pytest.mark.parametrize(
    ("phones", "duration", "message"),
    [
        ([("A", 0.0, 0.5), ("B", 0.4, 0.6)], 1.0, "phone 2 .* overlaps"),
        ([("A", 0.0, 1.5)], 1.0, "phone 1 .* ends after the end"),
        ([("A", math.nan, 0.5)], 1.0, "phone 1 .* no finite number"),
        ([("A", 0.6, 0.5)], 1.0, "phone 1 .* ends before it starts"),
        ([], 0.0, "the duration must be > 0 s"),
        ([], math.inf, "the duration must be > 0 s"),
    ],
)
def test_impossible_alignments_cannot_be_made(phones, duration, message):
    with pytest.raises(InputError, match=message):
        Alignment(tuple(Segment(*p) for p in phones), (), duration)


def test_cover_fills_and_joins_silences():
    said = [Segment("A", 0.2, 0.4), Segment(SIL, 0.4, 0.5), Segment("B", 0.6, 0.8)]
    assert cover(said, 1.0) == (
        Segment(SIL, 0.0, 0.2),
        Segment("A", 0.2, 0.4),
        Segment(SIL, 0.4, 0.6),
        Segment("B", 0.6, 0.8),
        Segment(SIL, 0.8, 1.0),
    )
    assert cover([], 1.0) == (Segment(SIL, 0.0, 1.0),)


@given(st.lists(st.sampled_from(["AA", "B", "T"]), max_size=5), st.floats(0, 9), st.floats(0.01, 9))
def test_spread_covers_the_span_without_gaps(labels, start, length):
    segments = spread(labels, start, start + length)
    assert [s.label for s in segments] == labels
    times = [s.start for s in segments] + [s.end for s in segments[-1:]]
    assert times == sorted(times)
    assert all(x.end == y.start for x, y in itertools.pairwise(segments))
    if labels:
        assert (times[0], times[-1]) == (start, start + length)


# Finding and checking


def test_the_textgrid_is_preferred_and_a_file_is_itself(tmp_path):
    for name in ("my clip.v2.lab", "my clip.v2.TextGrid", "my clip.TextGrid"):
        (tmp_path / name).write_text("x")
    assert find_alignment(tmp_path, "videos/my clip.v2.mp4").name == "my clip.v2.TextGrid"
    (tmp_path / "my clip.v2.TextGrid").unlink()
    assert find_alignment(tmp_path, "my clip.v2.mp4").name == "my clip.v2.lab"
    assert find_alignment(tmp_path / "my clip.TextGrid", "b.mp4").name == "my clip.TextGrid"


def test_what_was_looked_for_is_said(tmp_path):
    with pytest.raises(InputError, match=r"holds no alignment of b\.mp4 \(none of b\.TextGrid"):
        find_alignment(tmp_path, "b.mp4")
    with pytest.raises(InputError, match="nowhere: no such file or folder"):
        find_alignment(tmp_path / "nowhere", "b.mp4")


def test_speech_after_the_end_of_the_clip_is_refused_and_silence_is_not():
    check_against(BIN, 0.79, "a.TextGrid")
    with pytest.raises(
        InputError, match=r"a\.TextGrid: ends at 0\.88 s but the clip ends at 0\.77"
    ):
        check_against(BIN, 0.77, "a.TextGrid")


# Time


def test_shift_moves_cuts_and_fills():
    assert shift(BIN, 0.0) == BIN
    late = shift(BIN, 0.22)
    assert late.words == (Segment("bin", 0.7 + 0.22, 1.0),)
    assert [p.label for p in late.phones] == [SIL, "B", "IH"]
    early = shift(BIN, -0.76)
    assert [p.label for p in early.phones] == ["IH", "N", SIL]
    assert early.phones[0].start == 0.0
    assert early.phones[-1].end == 1.0
    assert shift(BIN, 5.0).phones == (Segment(SIL, 0.0, 1.0),)
    with pytest.raises(InputError, match="finite"):
        shift(BIN, math.nan)


@given(alignments(), st.floats(-3, 3))
def test_shifted_phones_cover_the_clip(alignment, seconds):
    phones = shift(alignment, seconds).phones
    assert (phones[0].start, phones[-1].end) == (0.0, alignment.duration)
    assert all(x.end == y.start for x, y in itertools.pairwise(phones))


def label_at(alignment, second):
    return next((p.label for p in alignment.phones if p.start <= second < p.end), SIL)


@given(alignments(), st.integers(0, 40), st.sampled_from([10, 25, 30000 / 1001, 60]))
def test_a_frame_has_the_label_that_a_count_of_instants_gives(alignment, n_frames, fps):
    got = frame_labels(alignment, n_frames, fps)
    assert len(got) == n_frames
    n = 400  # instants a frame
    for t, label in enumerate(got):
        instants = [label_at(alignment, (t + (i + 0.5) / n) / fps) for i in range(n)]
        counts = {x: instants.count(x) for x in instants}
        tolerance = 2 * len(alignment.phones)  # instants lost at boundaries
        assert counts.get(label, 0) >= max(counts.values()) - tolerance


def test_equal_shares_go_to_the_first_and_pieces_add_up():
    halves = (Segment("A", 0.0, 0.06), Segment("B", 0.06, 0.1))
    assert frame_labels(Alignment(halves, (), 0.1), 4, 25) == ["A", "A", "B", SIL]
    noisy = (Segment("A", 0.04, 0.06), Segment("B", 0.06, 0.08))
    assert 0.06 - 0.04 < 0.08 - 0.06
    assert frame_labels(Alignment(noisy, (), 0.08), 2, 25) == [SIL, "A"]
    pieces = [Segment("A", 0.0, 0.03), Segment("B", 0.03, 0.07), Segment("A", 0.07, 0.1)]
    assert frame_labels(Alignment(tuple(pieces), (), 0.1), 1, 10) == ["A"]


def test_no_frames_and_impossible_rates():
    assert frame_labels(BIN, 0, 25) == []
    for n_frames, fps in ((-1, 25), (1, 0), (1, math.inf)):
        with pytest.raises(InputError, match="need n_frames >= 0 and fps > 0"):
            frame_labels(BIN, n_frames, fps)
