import ipaddress

from mmmgpu.web_pages import LOOPBACK, strict_headers


def test_loopback_is_this_computer():
    assert ipaddress.ip_address(LOOPBACK).is_loopback


def test_a_page_may_load_only_what_is_named():
    policy = strict_headers({"script-src": "'self'", "img-src": "data:"})["Content-Security-Policy"]
    directives = dict(part.split(" ", 1) for part in policy.split("; "))
    assert directives == {
        "default-src": "'none'",
        "script-src": "'self'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }


def test_nothing_is_kept_guessed_or_told():
    headers = strict_headers({})
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
