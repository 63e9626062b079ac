"""How far word boundaries of alignments are from those of others: ``python -m bench.alignment``.

Two folders with one alignment a clip: those to be judged, as TextGrids (of ``mmmgpu align``), and
those to judge by, in the format that is asked for. Words must be the same.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from mmmgpu.alignments import read_alignment


def boundary_errors(mine, theirs):
    """Differences (words, 2) [s] of where words begin and end; `mine` minus `theirs`."""
    labels = [[word.label for word in alignment.words] for alignment in (mine, theirs)]
    if labels[0] != labels[1]:
        raise SystemExit(f"not the same words: {labels[0]} and {labels[1]}")
    times = [[word[1:] for word in alignment.words] for alignment in (mine, theirs)]
    return np.subtract(*times)


def summary(errors):
    """Statistics of differences [s] in milliseconds."""
    ms = 1000 * np.abs(errors).ravel()
    return {
        "boundaries": len(ms),
        "median_ms": round(float(np.median(ms)), 1),
        "mean_ms": round(float(ms.mean()), 1),
        "p90_ms": round(float(np.percentile(ms, 90)), 1),
        "within_50_ms": round(float((ms <= 50).mean()), 3),
        "late_by_ms": round(1000 * float(np.median(errors)), 1),
    }


def main(arguments):
    """Print and write how far the boundaries are apart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("aligned", type=Path, help="folder of the TextGrids to be judged")
    parser.add_argument("truth", type=Path, help="folder of the alignments to judge by")
    parser.add_argument("--suffix", default=".align", help="of these; default: .align")
    parser.add_argument(
        "--every", type=int, default=12, help="clips 0, N, 2N, ... also on their own"
    )
    parser.add_argument("--json", help="write the results here")
    options = parser.parse_args(arguments)
    found = sorted(options.aligned.glob("*.TextGrid"))
    if not found:
        raise SystemExit(f"{options.aligned}: holds no TextGrid")
    errors = [
        boundary_errors(*map(read_alignment, (f, options.truth / (f.stem + options.suffix))))
        for f in found
    ]
    results = {
        "clips": len(found),
        "all": summary(np.concatenate(errors)),
        "starts": summary(np.concatenate(errors)[:, 0]),
        "ends": summary(np.concatenate(errors)[:, 1]),
        f"clips 0, {options.every}, ...": summary(np.concatenate(errors[:: options.every])),
    }
    print(json.dumps(results, indent=1))
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
