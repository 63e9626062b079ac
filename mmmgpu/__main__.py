"""``python -m mmmgpu`` is the command ``mmmgpu``."""

from mmmgpu.cli import main

if __name__ == "__main__":
    main()
