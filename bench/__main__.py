"""``python -m bench``: the same as ``mmmgpu bench``."""

import sys

from mmmgpu.cli import main

sys.argv.insert(1, "bench")
main()
