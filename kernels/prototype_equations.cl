/* Normal equations of prototypes moved along a flow, of which no picture is kept.
 *
 * All prototypes go on together, a band of rows at a time, each with its own residual flow, ring of
 * sums and pyramid (see orientation, rings). Holes that need more of the pyramid than there is then are
 * set aside, in all prototypes, until the pyramids are complete. normal_equations.multiply is given the
 * bands, and then these pixels.
 */

#include "lanes.cl"
#include "orientation.cl"
#include "pyramid.cl"
#include "rings.cl"
#include "carrying.cl"

#define WHITE 65535.0f /* the brightest value of a texture */

/* Each prototype, until the rows before `bottom` are shown; before the first band, its residual flow.
 *
 * One that needs more rows of sums than there is room for only says so in its state.
 */
__kernel void advance(
    __global const float *flow,        /* (2, H, pitch) [px] between 16 numbers */
    __global const ushort16 *textures, /* from here to row_shares as in prototypes.cl */
    __global const float *own,
    __global const float *shares,
    __global const int *firsts,
    __global const int *neighbours,
    __global const int *rows,
    __global const int *targets,
    __global const int *starts,
    __global const int *row_taps,
    __global const float *row_shares,
    __global const int *used,          /* (N) prototypes */
    __global const float *scale,       /* (H, pitch) of what is shown; 0 where nothing is asked */
    const int height,
    const int width,
    const int size,                    /* of a pyramid without its finest level */
    const int ring,                    /* rows of sums that there is room for */
    const int nodes,                   /* pixels and cells of a prototype */
    const float hole,
    const int depth,                   /* rows of the highest band */
    const int top,
    const int bottom,
    const int first,
    const int count,
    /* outputs */
    __global float *residual,          /* (N, 2, nodes) [px] */
    __global int *opens,               /* (N, H + 1) see reach */
    __global int4 *states,             /* (N) see carry_on; of holes those that are left */
    __global float *total,             /* (N, ring, pitch + 40, 4) scratch: sums */
    __global float *cells,             /* (N, 4 size) the pyramids */
    __global int *places,              /* (N, 2, pitch) scratch */
    __global float *steps,             /* (N, 7, pitch) scratch */
    __global int *holes,               /* (N, H, pitch) the holes that there are still */
    __global float *flags,             /* (H, pitch) 1 where one of the prototypes has one */
    __global float *band)              /* (N, 3, depth, pitch) of which each has 3 (bottom - top) rows */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = first + tid;
    const int pitch = pitch_of(width);
    const int across = pitch_of((width + 1) / 2);
    const int area = height * pitch;
    const int apart = (bottom - top) * pitch;
    const int row = COLOUR * (pitch + MARGIN);
    residual += 2 * p * nodes;
    opens += p * (height + 1);
    total += p * ring * row;
    cells += 4 * p * size;
    holes += p * area;
    band += (3 * p * depth - top) * pitch;
    if (top == 0) {
        orient(used[p], own + LANES, shares, firsts, neighbours, rows, targets, starts, row_taps,
               row_shares, area, pitch, nodes, 1, flow + LANES, residual);
        states[p] = (int4)(reach(residual + nodes, height, pitch, opens), 0, 0, 0);
        for (int y = 1; y <= 4 * ((height + 1) / 2); ++y) /* what pads the rows of the first level */
            put(cells + y * across - LANES, (float16)0.0f);
    }
    if (states[p].x > ring) /* the host will make more room */
        return;
    if (top == 0)
        for (int i = 0; i < states[p].x * row; i += LANES)
            put(total + i, (float16)0.0f);
    const int known = states[p].w;
    const int4 now = carry_on(textures + COLOUR * used[p] * area / LANES, height, width, pitch,
        residual, residual + nodes, hole, 1.0f / WHITE, scale, total, cells, opens,
        places + 2 * p * pitch, steps + 7 * p * pitch, holes, states[p], bottom, 0, apart, band);
    holes += known;
    const int left = mend(holes, now.w - known, height, width, pitch, bottom, 1.0f / WHITE, scale,
                          cells, apart, band);
    for (int k = 0; k < left; ++k)
        flags[holes[k]] = 1.0f;
    states[p] = (int4)(now.x, now.y, now.z, known + left);
}

/* Move some pixels of a vector aside: of one picture, of which the band has three planes `apart`. */
void take(__global float *from, const int apart, const int *lanes, const int number,
          __global float *to)
{
    for (int k = 0; k < number; ++k)
        for (int c = 0; c < 3; ++c) {
            to[3 * k + c] = from[c * apart + lanes[k]];
            from[c * apart + lanes[k]] = 0.0f;
        }
}

/* A row of what is wanted; and of all pictures, the pixels of a row that are a hole in one of them.
 *
 * Those that there is no room for are only counted, and stay in the band.
 */
__kernel void set_aside(
    __global const float *flags,
    __global const float *wanted,      /* (3, H, pitch) */
    const int number,
    const int height,
    const int width,
    const int depth,
    const int room,                    /* pixels that can be set aside */
    const int top,
    const int bottom,
    const int first,
    const int count,                   /* bottom - top rows */
    /* outputs */
    __global float *band,              /* 0 in their places */
    __global float *band_wanted,       /* (3, bottom - top, pitch) */
    __global float *aside,             /* (N, room, 3) */
    __global float *aside_wanted,      /* (room, 3) */
    __global int *slots,               /* (H, pitch) where a pixel is set aside */
    __global int *ends)                /* (H + 1) pixels that are set aside before each row; the first is 0 */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int y = first + tid;
    const int pitch = pitch_of(width);
    const int apart = (bottom - top) * pitch;
    const int here = y * pitch;
    for (int c = 0; c < 3; ++c)
        for (int x = 0; x < pitch; x += LANES)
            put(band_wanted + c * apart + here + x,
                get(wanted + (c * height + top) * pitch + here + x));
    flags += top * pitch;
    slots += top * pitch;
    float16 before = (float16)0.0f;
    for (int i = 0; i < here; i += LANES)
        before += get(flags + i);
    int slot = ends[top] + (int)sum(before);
    for (int x = 0; x < pitch; x += LANES) {
        int lanes[LANES];
        int some = 0;
        if (sum(get(flags + here + x)) == 0.0f)
            continue;
        for (int j = 0; j < LANES; ++j)
            if (flags[here + x + j] > 0.0f) {
                slots[here + x + j] = slot + some;
                lanes[some++] = j;
            }
        if (slot + some <= room) {
            for (int p = 0; p < number; ++p)
                take(band + 3 * p * depth * pitch + here + x, apart, lanes, some,
                     aside + 3 * (p * room + slot));
            take(band_wanted + here + x, apart, lanes, some, aside_wanted + 3 * slot);
        }
        slot += some;
    }
    ends[top + y + 1] = slot;
}

/* Fill the holes of each prototype, where they are set aside. */
__kernel void finish(
    __global const int *holes,
    __global const int *slots,
    __global const float *scale,
    __global const int4 *states,
    const int height,
    const int width,
    const int size,
    const int room,
    const int first,
    const int count,
    /* outputs */
    __global float *cells,
    __global float *aside,
    __global int *arrived)             /* (N) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = first + tid;
    const int pitch = pitch_of(width);
    const int found = states[p].w;
    cells += 4 * p * size;
    holes += p * height * pitch;
    aside += 3 * p * room;
    arrived[p] = found == 0 || fill(cells, (height + 1) / 2, (width + 1) / 2);
    if (arrived[p] == 0)
        return;
    for (int k = 0; k < found; ++k) {
        const int i = holes[k];
        const float4 colour = scale[i] / WHITE * between(cells, height, width, i / pitch, i % pitch);
        __global float *at = aside + 3 * slots[i];
        at[0] = colour.x;
        at[1] = colour.y;
        at[2] = colour.z;
    }
}
