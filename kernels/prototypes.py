"""Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.

A worker takes one prototype after the other of a group of up to four mixtures: the flow that is
missing to it is carried to its pixels (orientation), for all at once, and these along that flow
into sums that belong to the worker alone (rings). Flows are planes, one a direction, with rows
padded to whole vectors; a padded row is a pitch.
"""

import warp as wp

from mmmgpu.kernels.carrying import carry
from mmmgpu.kernels.lanes import (
    LANES,
    get,
    pitch_of,
    put,
    uvec16,
    vec16,
)
from mmmgpu.kernels.orientation import orient
from mmmgpu.kernels.rings import COLOUR, MARGIN

wp.set_module_options({"enable_backward": False})

WHITE = wp.constant(65535.0)  # the brightest value of a texture


@wp.kernel
def mix_prototypes(
    flows: wp.array[float],  # (frames, 2, H, pitch) [px]; mixture b is along b % frames
    textures: wp.array[uvec16],  # (M, H, pitch, 4) of 65535; a weight of 1
    own: wp.array[float],  # (M, 2, H, pitch) [px] flows of the prototypes, between 16 numbers
    shares: wp.array[float],  # (M, H, pitch) one over the weight along it; 0 in holes
    firsts: wp.array[int],  # (M * H * pitch / 16 + 1) first neighbours of a vector
    neighbours: wp.array[wp.vec3i],  # (parts) how far right, down, and for which pixels, as bits
    rows: wp.array[int],  # (M + 1) first row of each prototype
    targets: wp.array[int],  # (rows) what a row is for: a pixel, or from H * pitch on a cell
    starts: wp.array[int],  # (rows + 1) its first tap
    row_taps: wp.array[int],  # pixels or cells, of rows before
    row_shares: wp.array[float],
    parts: wp.array[int],  # (groups + 1) first member of each group
    members: wp.array[int],  # (parts[groups]) prototypes
    weights: wp.array[float],  # (parts[groups], together) their weights, 0 for none
    scale: wp.array[float],  # (H, pitch) of what is written; 0 where nothing is asked for
    frames: int,
    mixtures: int,
    together: int,  # mixtures of a group: 1, 2 or 4
    height: int,
    width: int,
    size: int,  # of a pyramid without its finest level
    ring: int,  # rows of sums: a power of two, not less than H
    nodes: int,  # pixels and cells of a prototype
    hole: float,
    workers: int,
    first: int,
    count: int,
    # outputs
    total: wp.array[float],  # (workers, ring, pitch + 40, 4) scratch: sums
    cells: wp.array[float],  # (workers, 4 size) scratch
    field: wp.array[float],  # (workers, together, 2, H * pitch + 16) scratch
    residual: wp.array[float],  # (workers, together, 2, nodes) scratch
    opens: wp.array[int],  # (workers, H + 1) scratch
    places: wp.array[int],  # (workers, 2, pitch) scratch
    steps: wp.array[float],  # (workers, 7, pitch) scratch
    holes: wp.array[int],  # (workers, H, pitch) scratch
    mixed: wp.array[float],  # (mixtures, 3, H, pitch)
    arrived: wp.array[int],  # (mixtures,) 0 where a prototype has nothing but holes
):
    tid = wp.tid()
    if tid >= count:
        return
    worker = first + tid
    pitch = pitch_of(width)
    area = height * pitch
    row = COLOUR * (pitch + MARGIN)
    here = worker * ring * row
    cell = 4 * worker * size
    there = 2 * together * worker * (area + LANES) + LANES
    missing = 2 * together * worker * nodes
    open = worker * (height + 1)
    place = 2 * worker * pitch
    step = 7 * worker * pitch
    list = worker * area
    for i in range(0, ring * row, LANES):
        put(total, here + i, vec16())
    for i in range(0, 4 * size, LANES):
        put(cells, cell + i, vec16())
    for i in range(0, 2 * together * (area + LANES), LANES):
        put(field, there - LANES + i, vec16())
    for group in range(worker, (mixtures + together - 1) / together, workers):
        job = together * group
        number = wp.min(together, mixtures - job)
        for f in range(number):
            if frames > 1 or group == worker:
                to = there + 2 * f * (area + LANES)
                for i in range(0, 2 * area, LANES):
                    put(field, to + i, get(flows, 2 * ((job + f) % frames) * area + i))
            arrived[job + f] = 1
        begun = int(0)  # mixtures that have a prototype, as bits
        for part in range(parts[group], parts[group + 1]):
            m = members[part]
            orient(
                m,
                own,
                shares,
                firsts,
                neighbours,
                rows,
                targets,
                starts,
                row_taps,
                row_shares,
                area,
                pitch,
                nodes,
                number,
                field,
                there,
                residual,
                missing,
            )
            for f in range(number):
                weight = weights[together * part + f] / WHITE
                if weight != 0.0:
                    right = missing + 2 * f * nodes
                    some = carry(
                        textures,
                        COLOUR * m * area / LANES,
                        height,
                        width,
                        pitch,
                        residual,
                        right,
                        right + nodes,
                        hole,
                        weight,
                        scale,
                        total,
                        here,
                        cells,
                        cell,
                        opens,
                        open,
                        places,
                        place,
                        steps,
                        step,
                        holes,
                        list,
                        (begun >> f) & 1,
                        mixed,
                        3 * (job + f) * area,
                    )
                    if some == 0:
                        arrived[job + f] = 0
                    begun |= 1 << f
        for f in range(number):
            if ((begun >> f) & 1) == 0:
                for i in range(0, 3 * area, LANES):
                    put(mixed, 3 * (job + f) * area + i, vec16())
