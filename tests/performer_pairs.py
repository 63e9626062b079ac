"""Two drawn performers who show the same: A's prototypes, and 450 frames of B with each of them.

What a frame shows is known to the last articulator, so that a match can be judged without a look.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from worlds import hold, say, sentence_motion

from mmmgpu.basis import Basis, make_basis, still_outside
from mmmgpu.correspondence import rbf_correspondence
from mmmgpu.flow_matching import SMOOTHING, View
from mmmgpu.flows import best_flow, matcher
from mmmgpu.marking import LANDMARK_ROWS
from mmmgpu.parallel import map_ordered, one_thread_each
from mmmgpu.performer import ARTICULATORS, Articulation, Performer, landmarks, performer, render
from mmmgpu.performer_geometry import columns, pucker
from mmmgpu.performer_mouth import lower_teeth_edge, upper_teeth_edge
from mmmgpu.prototypes import choose_prototypes
from mmmgpu.reference_pairs import most_open
from mmmgpu.regions import lip_mask, mouth_mask, region_around
from mmmgpu.transferring import carried_mask, frame_matcher

PROTOTYPES, FRAMES = 46, 450
APART = 1.0  # [px] of two points in one frame, or the second is left out
ALIKE = 0.05  # of a parameter's range: as near as a match must be
UPPER, LOWER, PRESS, BITE = (
    ARTICULATORS.index(name) for name in ("upper_lip", "lower_lip", "press", "bite")
)
SAID_BY_A = (
    "P AA P AH B AO T AH B IH G B L UW B OW T M AY M AH DH ER M EY K S W AO R M AE P AH L",
    "F AY V F AE T F AA K S AH Z F AW N D AH V EY S SH IY S EH L Z F R EH SH F IH SH",
    "W IY W ER AH W EY AO L W IY K IH N DH AH W UH D Z Y UW K UH D P UH T AH G UH D B UH K",
    "DH AH JH AH JH AE N D CH AY L D CH OW Z AO R AH N JH HH AW L AW D TH IH NG K N AO R TH",
    "B L AE K K AE T S K AE CH R AE T S L EH T T EH N M EH N G EH T W EH T P EH N Z",
)
SAID_BY_B = (
    "W AH N T UW TH R IY F AO R F AY V SIL S IH K S S EH V AH N EY T N AY N T EH N",
    "W IY P EY N T DH AH B AA R N R EH D IH N M EY SIL Y UW S IY DH AH M UW N",
    "P L IY Z L IY V DH AH K IY W IH DH B AA B SIL SH OW M IY AH V AE S T JH OY F AH L",
    "HH AW D UW Y UW N OW DH AH W EY HH OW M SIL CH IH L D ER V AH L AH P G UH D SH UW Z",
)


@dataclass(frozen=True)
class Pair:
    """A and B. Frames of A are its prototypes, the first its closed reference.

    shows_a, shows_b: what they do, of 46 and 450 frames.
    counterpart: the frame of B that does what a prototype does, (46,).
    source: A's basis, flows from the closed reference. target: all of B's frames.
    opened: A's most open prototype.
    flows_a, flows_b: by kind of reference, (46, h, w, 2) and (450, h', w', 2).
    """

    face_a: Performer
    face_b: Performer
    shows_a: Articulation
    shows_b: Articulation
    counterpart: np.ndarray
    source: Basis
    target: Basis
    opened: int
    flows_a: dict
    flows_b: dict


@cache
def make_pair(seed, size=(256, 256)):
    """Performers 2 `seed` and 2 `seed` + 1."""
    rng = np.random.default_rng(seed)
    faces = [performer(2 * seed + i, size=size) for i in (0, 1)]
    shows_a = still(_prototypes(faces[0], rng))
    spoken = _speech(faces[1], SAID_BY_B, 0.13)
    others = spoken[: FRAMES - PROTOTYPES]
    places = rng.permutation(FRAMES)  # where B shows A's prototypes, and then all else
    values = np.empty((FRAMES, len(ARTICULATORS)))
    values[places] = np.concatenate([shows_a.values, others])
    shows_b, counterpart = still(values), places[:PROTOTYPES]
    with one_thread_each():
        source, opened, flows_a = _basis_of_a(faces[0], shows_a, rng)
        target, flows_b = _basis_of_b(faces[1], shows_b, [counterpart[0], counterpart[opened]], rng)
    return Pair(*faces, shows_a, shows_b, counterpart, source, target, opened, flows_a, flows_b)


def still(values):
    """Frames with these articulators, (T, 9), and the head and the eyes at rest."""
    return replace(hold(*[{}] * len(values)), values=np.asarray(values))


def _speech(face, sentences, phone):
    """The articulators of `face` saying `sentences` in its own way, (T, 9)."""
    rng = np.random.default_rng(0)
    said = [sentence_motion(face, say(s, phone=phone), rng).values for s in sentences]
    return np.concatenate(said)


def _prototypes(face, rng):
    """Rest, and what `face` shows when it speaks, chosen as `train` chooses, (46, 9)."""
    spoken = _speech(face, SAID_BY_A, 0.11)
    tongue = spoken[:, 7:] * (tongue_window(face, spoken) > 1)[:, None]
    coordinates = np.concatenate([lips(spoken), tongue], axis=1).astype(np.float32)
    chosen = choose_prototypes(coordinates, PROTOTYPES - 1, seed=int(rng.integers(1000)))
    return np.concatenate([hold({}).values, spoken[chosen]])


def lips(values):
    """What of the articulators (T, 9) moves lips and jaw, (T, 7), each in [0, 1].

    Lips that are pressed or bitten do not part, however much they are raised or lowered: so far as
    `performer_geometry.pucker` leaves them.
    """
    closed = np.clip((values[:, PRESS] - 0.35) / 0.45, 0, 1)
    free = (1 - closed**2 * (3 - 2 * closed)) * (1 - values[:, BITE])
    shown = values[:, : BITE + 1].copy()
    shown[:, [UPPER, LOWER]] *= free[:, None]
    return shown


def tongue_window(face, values):
    """How high the opening is in which a tongue can be seen [px], (T,); negative: not at all.

    In the middle of the mouth, between the lips and the rows of teeth: the upper teeth hide the
    tongue, the lower ones do unless it is put forward over them (`performer_mouth`).
    """
    heights = []
    for row in values:
        posture = dict(zip(ARTICULATORS, map(float, row), strict=True))
        p = pucker(face.shape, posture)
        edges = columns(face.shape, p, np.zeros(1))
        low = float(edges.lower_lip()[0])
        if posture["tongue_advance"] < 0.75:
            low = min(low, lower_teeth_edge(face.shape, p))
        top = max(float(edges.upper_lip()[0]), upper_teeth_edge(face.shape))
        heights.append((low - top) * face.scale)
    return np.array(heights)


def alike(face, values, wanted):
    """Which frames (T, 9) show the same as the frames `wanted` (T, 9), as far as it shows, (T,).

    All that moves lips and jaw is within `ALIKE` of its range, [0, 1]; so are height and advance of
    the tongue if it can be seen in either. The lower teeth go with the jaw, the upper ones are
    fixed: both are as alike as the lips are.
    """
    near = (np.abs(lips(values) - lips(wanted)) <= ALIKE).all(axis=1)
    window = np.maximum(tongue_window(face, values), tongue_window(face, wanted))
    tongue = (np.abs(values - wanted)[:, BITE + 1 :] <= ALIKE).all(axis=1)
    return near & (tongue | (window < 1))


def found(pair, chosen):
    """For which prototypes the frame `chosen` (46,) is the counterpart, or like it, (46,)."""
    shown = pair.shows_b.values
    same = alike(pair.face_b, shown[chosen], shown[pair.counterpart])
    return same | (chosen == pair.counterpart)


def views_of(pair, kinds=("closed", "open"), noise=0.0, seed=0):
    """`View`s with the 38 points, marked with Gaussian errors of `noise` [px] in either picture."""
    numbers = {"closed": 0, "open": pair.opened}
    views = []
    for kind in kinds:
        rng = np.random.default_rng([seed, numbers[kind]])
        points = points_of(pair, numbers[kind])
        at = [p + noise * rng.standard_normal(p.shape) for p in points]
        s = rbf_correspondence(*at, smoothing=SMOOTHING)
        views.append(View(s, pair.flows_a[kind], pair.flows_b[kind]))
    return views


def points_of(pair, k):
    """The paper's points in prototype k and its counterpart, in pixels of the regions, (n, 2) each.

    Of points that meet, as those of closed lips do, the first is kept.
    """
    sides = (
        (pair.face_a, pair.shows_a, k, pair.source.region),
        (pair.face_b, pair.shows_b, int(pair.counterpart[k]), pair.target.region),
    )
    at = [
        landmarks(face, shows, t)[list(LANDMARK_ROWS)] - region.box[:2]
        for face, shows, t, region in sides
    ]
    kept = []
    for i in range(len(LANDMARK_ROWS)):
        if all((np.linalg.norm(p[kept] - p[i], axis=1) > APART).all() for p in at):
            kept.append(i)
    return at[0][kept], at[1][kept]


def target_of(pair):
    """B's frames, with A's masks carried over as transfer does."""
    s = rbf_correspondence(*points_of(pair, 0))
    masks = [
        carried_mask(mask, s, pair.target.w_t.shape) for mask in (pair.source.w_f, pair.source.w_t)
    ]
    return replace(pair.target, w_f=masks[0], w_t=masks[1])


def mouth_pictures(face, shows, region, rng):
    """The region of every frame, (T, h, w, 3) float32 in [0, 1], with the camera's noise."""
    x, y, w, h = region.box
    frames = render(face, shows, rng=rng)
    return np.stack([f[y : y + h, x : x + w].astype(np.float32) / 255 for f in frames])


def _region(face, shows, t):
    lips_ = landmarks(face, shows, t)[:20]
    mouth = (*lips_.mean(axis=0), np.ptp(lips_[:, 0]))
    return region_around(mouth, face.size[::-1])


def _basis_of_a(face, shows, rng):
    region = _region(face, shows, 0)
    images = mouth_pictures(face, shows, region, rng)
    direct = _flows(images, [0], mouth_mask(region), matcher())[0]
    opened = most_open(make_basis(images, direct, 0, region))
    closed, from_open = _flows(images, [0, opened], mouth_mask(region), matcher())
    basis = make_basis(images, closed, 0, region)
    return basis, opened, {"closed": basis.flows, "open": still_outside(from_open, basis.cover)}


def _basis_of_b(face, shows, origins, rng):
    region = _region(face, shows, origins[0])
    images = mouth_pictures(face, shows, region, rng)
    flows = _flows(images, origins, mouth_mask(region), frame_matcher("dis", region))
    masks = lip_mask(region), mouth_mask(region), mouth_mask(region)
    kinds = dict(zip(("closed", "open"), flows, strict=True))
    return Basis(images, flows[0], int(origins[0]), region, *masks), kinds


def _flows(images, origins, mask, match):
    """Flows of all images from each of the frames `origins`, direct or by another origin."""
    found = []
    for o in origins:
        via = [(images[i], match(images[o], images[i])) for i in origins if i != o]

        def flow(image, _, o=o, via=via):
            return best_flow(images[o], image, mask, via, match)

        found.append(np.stack(list(map_ordered(flow, images, threads=2))))
    return found
