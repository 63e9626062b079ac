"""Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.

A worker takes one prototype of one frame after the other: the flow that is missing to it is carried
to its pixels (orientation), and these along that flow into sums that belong to the worker alone
(rings). Flows are planes, one a direction, with rows padded to whole vectors; a padded row is a
pitch.
"""

import warp as wp

from mmmgpu.kernels.lanes import (
    LANES,
    get,
    pitch_of,
    put,
    uvec16,
    vec16,
)
from mmmgpu.kernels.orientation import orient
from mmmgpu.kernels.pyramid import fill
from mmmgpu.kernels.rings import COLOUR, MARGIN, aim, mend, reach, show, splat

wp.set_module_options({"enable_backward": False})

WHITE = wp.constant(65535.0)  # the brightest value of a texture


@wp.kernel
def mix_prototypes(
    flows: wp.array[float],  # (frames, 2, H, pitch) [px] of the model; frames: 1 or the mixtures
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
    parts: wp.array[int],  # (mixtures + 1) first member of each mixture
    members: wp.array[int],  # (parts[mixtures]) prototypes
    weights: wp.array[float],  # (parts[mixtures]) their weights
    scale: wp.array[float],  # (H, pitch) of what is written; 0 where nothing is asked for
    frames: int,
    mixtures: int,
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
    field: wp.array[float],  # (workers, 2, H * pitch + 16) scratch
    residual: wp.array[float],  # (workers, 2, nodes) scratch
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
    there = 2 * worker * (area + LANES) + LANES
    right = 2 * worker * nodes
    down = right + nodes
    open = worker * (height + 1)
    place = 2 * worker * pitch
    step = 7 * worker * pitch
    list = worker * area
    for i in range(ring * row):
        total[here + i] = 0.0
    for i in range(4 * size):
        cells[cell + i] = 0.0
    for i in range(2 * (area + LANES)):
        field[there - LANES + i] = 0.0
    for job in range(worker, mixtures, workers):
        out = 3 * job * area
        if frames > 1 or job == worker:
            for i in range(0, 2 * area, LANES):
                put(field, there + i, get(flows, 2 * (job % frames) * area + i))
        arrived[job] = 1
        if parts[job] == parts[job + 1]:
            for i in range(0, 3 * area, LANES):
                put(mixed, out + i, vec16())
        for part in range(parts[job], parts[job + 1]):
            m = members[part]
            weight = weights[part] / WHITE
            more = wp.where(part > parts[job], 1, 0)
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
                field,
                there,
                residual,
                right,
            )
            used = reach(residual, down, height, pitch, opens, open)
            shown = int(0)
            found = int(0)
            for y in range(height + 1):
                while shown < opens[open + y]:
                    found = show(
                        total,
                        here + (shown & (used - 1)) * row,
                        shown,
                        height,
                        width,
                        pitch,
                        hole,
                        weight,
                        scale,
                        more,
                        mixed,
                        out,
                        cells,
                        cell,
                        holes,
                        list,
                        found,
                    )
                    shown += 1
                if y < height:
                    aim(
                        textures,
                        COLOUR * (m * area + y * pitch) / LANES,
                        y,
                        height,
                        width,
                        pitch,
                        residual,
                        right + y * pitch,
                        down + y * pitch,
                        used,
                        places,
                        place,
                        steps,
                        step,
                    )
                    splat(pitch, places, place, steps, step, total, here)
            if found > 0:
                if fill(cells, cell, (height + 1) / 2, (width + 1) / 2) == 1:
                    mend(
                        holes,
                        list,
                        found,
                        height,
                        width,
                        pitch,
                        weight,
                        scale,
                        cells,
                        cell,
                        mixed,
                        out,
                    )
                else:
                    arrived[job] = 0
