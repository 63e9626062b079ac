"""How many counterparts matching finds where they are known: ``known_truth.py --help``.

Not a test: a pair of drawn performers takes a minute or more. Shown is the share of 46 prototypes
whose frame shows the same: by the flow of the map alone, by calibrated flow, and at the end.
"""

import argparse

import numpy as np
from performer_pairs import found, make_pair, target_of, views_of

from mmmgpu.matching import match_prototypes


def shares(pair, noise, marking):
    """Three shares of a pair, its points marked with errors of `noise` [px]; and how it ended."""
    fixed = [(0, int(pair.counterpart[0]))]
    views = views_of(pair, noise=noise, seed=marking)
    got = match_prototypes(pair.source, target_of(pair), views, fixed=fixed)
    stages = (got.flow_history[0], got.history[0], got.chosen)
    return [found(pair, chosen).mean() for chosen in stages], got


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("seeds", type=int, nargs="+", help="of the pairs")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 2.0], help="of points [px]")
    parser.add_argument("--size", type=int, default=256, help="of the square pictures [px]")
    parser.add_argument("--marking", type=int, default=0, help="seed of the noise")
    options = parser.parse_args()
    rows = {noise: [] for noise in options.noise}
    for seed in options.seeds:
        pair = make_pair(seed, (options.size, options.size))
        for noise in options.noise:
            found_, got = shares(pair, noise, options.marking)
            rows[noise].append(found_)
            said = " ".join(f"{share:.2f}" for share in found_)
            steps = f"{len(got.flow_history) - 1} + {len(got.history) - 1} iterations"
            print(f"pair {seed}, noise {noise:g} px: {said}   {steps}, {got.outcome}", flush=True)
        make_pair.cache_clear()
    for noise, several in rows.items():
        print(
            f"mean, noise {noise:g} px: " + " ".join(f"{v:.3f}" for v in np.mean(several, axis=0))
        )


if __name__ == "__main__":
    main()
