from mmmgpu.report_tables import error_table, lip_table, picture_table, table


def test_cells_are_escaped():
    html = table(("a", "b"), [("<x>", "1")])
    assert "&lt;x&gt;" in html
    assert "<x>" not in html


def test_errors_have_their_intervals_and_one_clip_has_none():
    def entry(half):
        value = {"mean": 0.125, "half_width_95": half, "clips": 1}
        return {
            "rms": {"pooled": value, "trained": value},
            "rms_gain": {"mean": 0.0625, "half_width_95": half, "clips": 1},
            "correlation_trained": 0.5,
            "variance_ratio_pooled": 0.25,
            "variance_ratio_trained": 0.75,
        }

    sure = {s: {p: entry(0.01) for p in ("all", "speech")} for s in ("alpha", "beta")}
    single = {s: {p: entry(None) for p in ("all", "speech")} for s in ("alpha", "beta")}
    assert error_table(sure).count("0.0625 ± 0.0100") == 4
    assert "±" not in error_table(single)


def test_lips_and_pictures_have_tables():
    kinds = ("real", "analysed", "pooled", "trained")
    made = kinds[1:]
    lips = {
        "distance_px_speech": {k: {"mean": 1.5, "half_width_95": 0.2, "clips": 2} for k in made},
        "jitter_px_silence": dict.fromkeys(kinds, 0.0625),
        "opening_speech": {k: {"correlation": 0.9, "variance_ratio": 0.5} for k in made},
        "opening_px_silence": dict.fromkeys(kinds, 12.0),
    }
    assert lip_table(lips).count("1.50 ± 0.20") == 3
    assert lip_table(lips).count(">0.062<") == 4
    speech = {"psnr_db": 34.56, "worst_frame_db": 30.0, "ssim": 0.9512}
    html = picture_table([{"clip": "a.mp4", "speech": speech}])
    assert "34.6" in html
    assert "0.951" in html
    assert "silence" not in html
