import subprocess
import sys

SAID_TWICE = """
import warnings
from mmmgpu.errors import UnsettledWarning, say_warnings

say_warnings()
for number in (4, 4, 5):
    warnings.warn(UnsettledWarning(f"slds: still gaining after {number} iterations"))
"""


def test_a_warning_is_one_line_and_said_once():
    given = [sys.executable, "-c", SAID_TWICE]
    ended = subprocess.run(given, capture_output=True, text=True, check=True)
    assert ended.stderr.splitlines() == [
        "warning: slds: still gaining after 4 iterations",
        "warning: slds: still gaining after 5 iterations",
    ]
