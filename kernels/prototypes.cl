/* Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.
 *
 * A worker takes one prototype of one frame after the other: the flow that is missing to it is carried
 * to its pixels (orientation), and these along that flow into sums that belong to the worker alone
 * (rings). Flows are planes, one a direction, with rows padded to whole vectors; a padded row is a
 * pitch.
 */

#include "lanes.cl"
#include "orientation.cl"
#include "pyramid.cl"
#include "rings.cl"

#define WHITE 65535.0f /* the brightest value of a texture */

__kernel void mix_prototypes(
    __global const float *flows,       /* (frames, 2, H, pitch) [px]; frames: 1 or the mixtures */
    __global const ushort16 *textures, /* (M, H, pitch, 4) of 65535; a weight of 1 */
    __global const float *own,         /* (M, 2, H, pitch) [px] their flows, between 16 numbers */
    __global const float *shares,      /* (M, H, pitch) one over the weight along it; 0 in holes */
    __global const int *firsts,        /* (M * H * pitch / 16 + 1) first neighbours of a vector */
    __global const int *neighbours,    /* (parts, 3) right, down, and for which pixels, as bits */
    __global const int *rows,          /* (M + 1) first row of each prototype */
    __global const int *targets,       /* (rows) a pixel, or from H * pitch on a cell */
    __global const int *starts,        /* (rows + 1) its first tap */
    __global const int *row_taps,      /* pixels or cells, of rows before */
    __global const float *row_shares,
    __global const int *parts,         /* (mixtures + 1) first member of each mixture */
    __global const int *members,       /* (parts[mixtures]) prototypes */
    __global const float *weights,     /* (parts[mixtures]) their weights */
    __global const float *scale,       /* (H, pitch) of what is written; 0 where nothing is asked */
    const int frames,
    const int mixtures,
    const int height,
    const int width,
    const int size,                    /* of a pyramid without its finest level */
    const int ring,                    /* rows of sums: a power of two, not less than H */
    const int nodes,                   /* pixels and cells of a prototype */
    const float hole,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global float *total,             /* (workers, ring, pitch + 40, 4) scratch: sums */
    __global float *cells,             /* (workers, 4 size) scratch */
    __global float *field,             /* (workers, 2, H * pitch + 16) scratch */
    __global float *residual,          /* (workers, 2, nodes) scratch */
    __global int *opens,               /* (workers, H + 1) scratch */
    __global int *places,              /* (workers, 2, pitch) scratch */
    __global float *steps,             /* (workers, 7, pitch) scratch */
    __global int *holes,               /* (workers, H, pitch) scratch */
    __global float *mixed,             /* (mixtures, 3, H, pitch) */
    __global int *arrived)             /* (mixtures,) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int worker = first + tid;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int row = COLOUR * (pitch + MARGIN);
    total += worker * ring * row;
    cells += 4 * worker * size;
    field += 2 * worker * (area + LANES);
    residual += 2 * worker * nodes;
    opens += worker * (height + 1);
    places += 2 * worker * pitch;
    steps += 7 * worker * pitch;
    holes += worker * area;
    for (int i = 0; i < ring * row; ++i)
        total[i] = 0.0f;
    for (int i = 0; i < 4 * size; ++i)
        cells[i] = 0.0f;
    for (int i = 0; i < 2 * (area + LANES); ++i)
        field[i] = 0.0f;
    field += LANES;
    own += LANES;
    for (int job = worker; job < mixtures; job += workers) {
        __global float *out = mixed + 3 * job * area;
        if (frames > 1 || job == worker)
            for (int i = 0; i < 2 * area; ++i)
                field[i] = flows[2 * (job % frames) * area + i];
        arrived[job] = 1;
        if (parts[job] == parts[job + 1])
            for (int i = 0; i < 3 * area; ++i)
                out[i] = 0.0f;
        for (int part = parts[job]; part < parts[job + 1]; ++part) {
            const int m = members[part];
            const float weight = weights[part] / WHITE;
            orient(m, own, shares, firsts, neighbours, rows, targets, starts, row_taps, row_shares,
                   area, pitch, nodes, field, residual);
            const int used = reach(residual + nodes, height, pitch, opens);
            int shown = 0;
            int found = 0;
            for (int y = 0; y <= height; ++y) {
                for (; shown < opens[y]; ++shown)
                    found = show(total + (shown & (used - 1)) * row, shown, height, width, pitch,
                                 hole, weight, scale, part > parts[job], out, cells, holes, found);
                if (y < height) {
                    aim(textures + COLOUR * (m * area + y * pitch) / LANES, y, height, width, pitch,
                        residual + y * pitch, residual + nodes + y * pitch, used, places, steps);
                    splat(pitch, places, steps, total);
                }
            }
            if (found > 0 && fill(cells, (height + 1) / 2, (width + 1) / 2))
                mend(holes, found, height, width, pitch, weight, scale, cells, out);
            else if (found > 0)
                arrived[job] = 0;
        }
    }
}
