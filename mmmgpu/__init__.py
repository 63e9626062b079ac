"""Image-based speech animation: learn a mouth from video and render it saying anything.

Names are loaded on first use, so that importing the package costs nothing. What each does is said
where it lives; see `_HOMES`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mmmgpu import aam, performer
    from mmmgpu.adaptation import adapt
    from mmmgpu.aligner import align_speech
    from mmmgpu.alignments import Alignment, Segment, read_alignment
    from mmmgpu.backends import BACKENDS, get_backend
    from mmmgpu.correspondence import rbf_correspondence
    from mmmgpu.errors import InputError
    from mmmgpu.evaluation import evaluate
    from mmmgpu.model_files import load
    from mmmgpu.models import Model
    from mmmgpu.operations import (
        blend,
        distance_scan,
        evaluate_rbf,
        fill_holes,
        forward_warp,
        normal_equations,
        piecewise_warp,
        sample,
    )
    from mmmgpu.reconstruction import reconstruct
    from mmmgpu.speaking import speak
    from mmmgpu.training import train
    from mmmgpu.transferring import transfer
    from mmmgpu.voices import say

__version__ = "0.1.0"

__all__ = [
    "BACKENDS",
    "Alignment",
    "InputError",
    "Model",
    "Segment",
    "__version__",
    "aam",
    "adapt",
    "align_speech",
    "blend",
    "distance_scan",
    "evaluate",
    "evaluate_rbf",
    "fill_holes",
    "forward_warp",
    "get_backend",
    "load",
    "normal_equations",
    "performer",
    "piecewise_warp",
    "rbf_correspondence",
    "read_alignment",
    "reconstruct",
    "sample",
    "say",
    "speak",
    "train",
    "transfer",
]

_HOMES = {
    "aam": [],  # the module itself
    "adaptation": ["adapt"],
    "aligner": ["align_speech"],
    "alignments": ["Alignment", "Segment", "read_alignment"],
    "backends": ["BACKENDS", "get_backend"],
    "correspondence": ["rbf_correspondence"],
    "errors": ["InputError"],
    "evaluation": ["evaluate"],
    "model_files": ["load"],
    "models": ["Model"],
    "operations": [
        "blend",
        "distance_scan",
        "evaluate_rbf",
        "fill_holes",
        "forward_warp",
        "normal_equations",
        "piecewise_warp",
        "sample",
    ],
    "performer": [],  # the module itself
    "reconstruction": ["reconstruct"],
    "speaking": ["speak"],
    "training": ["train"],
    "transferring": ["transfer"],
    "voices": ["say"],
}

if not TYPE_CHECKING:  # type checkers see the imports above, and no other name

    def __getattr__(name: str) -> object:
        """A public name, from the module it lives in (PEP 562)."""
        for module, names in _HOMES.items():
            if name in names:
                return getattr(import_module(f"mmmgpu.{module}"), name)
        if name in __all__:
            return import_module(f"mmmgpu.{name}")
        raise AttributeError(f"module 'mmmgpu' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
