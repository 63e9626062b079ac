"""Programs from outside that some tests need: a browser, a database server.

Without one its tests are skipped, unless an environment variable says that it must be there.
"""

import os
import shutil
from contextlib import contextmanager

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def missing(what, variable):
    """Skip the test, or fail where `variable` is 1."""
    if os.environ.get(variable) == "1":
        pytest.fail(f"{what}, and {variable}=1")
    pytest.skip(what)


@contextmanager
def running_chromium():
    """Chromium, driven by Playwright."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        missing("no Chromium on this machine", "MMMGPU_REQUIRE_BROWSER")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("Playwright is not installed", "MMMGPU_REQUIRE_BROWSER")
    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--disable-dev-shm-usage"]
        browser = playwright.chromium.launch(executable_path=path, args=options)
        yield browser
        browser.close()
