/* Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.
 *
 * A worker takes one prototype after the other of a group of up to four mixtures: the flow that is
 * missing to it is carried to its pixels (orientation), for all at once, and these along that flow
 * into sums that belong to the worker alone (rings). Flows are planes, one a direction, with rows
 * padded to whole vectors; a padded row is a pitch.
 */

#include "lanes.cl"
#include "orientation.cl"
#include "pyramid.cl"
#include "rings.cl"
#include "carrying.cl"

#define WHITE 65535.0f /* the brightest value of a texture */

__kernel void mix_prototypes(
    __global const float *flows,       /* (frames, 2, H, pitch) [px]; mixture b is along b % frames */
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
    __global const int *parts,         /* (groups + 1) first member of each group */
    __global const int *members,       /* (parts[groups]) prototypes */
    __global const float *weights,     /* (parts[groups], together) their weights, 0 for none */
    __global const float *scale,       /* (H, pitch) of what is written; 0 where nothing is asked */
    const int frames,
    const int mixtures,
    const int together,                /* mixtures of a group: 1, 2 or 4 */
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
    __global float *field,             /* (workers, together, 2, H * pitch + 16) scratch */
    __global float *residual,          /* (workers, together, 2, nodes) scratch */
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
    field += 2 * together * worker * (area + LANES);
    residual += 2 * together * worker * nodes;
    opens += worker * (height + 1);
    places += 2 * worker * pitch;
    steps += 7 * worker * pitch;
    holes += worker * area;
    for (int i = 0; i < ring * row; ++i)
        total[i] = 0.0f;
    for (int i = 0; i < 4 * size; ++i)
        cells[i] = 0.0f;
    for (int i = 0; i < 2 * together * (area + LANES); ++i)
        field[i] = 0.0f;
    field += LANES;
    own += LANES;
    for (int group = worker; together * group < mixtures; group += workers) {
        const int job = together * group;
        const int number = together < mixtures - job ? together : mixtures - job;
        for (int f = 0; f < number; ++f) {
            __global float *to = field + 2 * f * (area + LANES);
            __global const float *from = flows + 2 * ((job + f) % frames) * area;
            if (frames > 1 || group == worker)
                for (int i = 0; i < 2 * area; ++i)
                    to[i] = from[i];
            arrived[job + f] = 1;
        }
        int begun = 0; /* mixtures that have a prototype, as bits */
        for (int part = parts[group]; part < parts[group + 1]; ++part) {
            const int m = members[part];
            orient(m, own, shares, firsts, neighbours, rows, targets, starts, row_taps, row_shares,
                   area, pitch, nodes, number, field, residual);
            for (int f = 0; f < number; ++f) {
                const float weight = weights[together * part + f] / WHITE;
                __global const float *right = residual + 2 * f * nodes;
                if (weight == 0.0f)
                    continue;
                if (carry(textures + COLOUR * m * area / LANES, height, width, pitch, right,
                          right + nodes, hole, weight, scale, total, cells, opens, places, steps,
                          holes, begun >> f & 1, mixed + 3 * (job + f) * area) == 0)
                    arrived[job + f] = 0;
                begun |= 1 << f;
            }
        }
        for (int f = 0; f < number; ++f)
            if ((begun >> f & 1) == 0)
                for (int i = 0; i < 3 * area; ++i)
                    mixed[3 * (job + f) * area + i] = 0.0f;
    }
}
