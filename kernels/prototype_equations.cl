/* Normal equations of prototypes moved along a flow, of which no picture is kept.
 *
 * All prototypes go on together, a band of rows at a time. Pixels that are a hole in one of them are
 * set aside until the holes are filled, in the end.
 */

#include "lanes.cl"
#include "orientation.cl"
#include "pyramid.cl"
#include "rings.cl"

#define WHITE 65535.0f

__kernel void begin(
    __global const float *flow,
    __global const float *own,
    __global const float *shares,
    __global const int *firsts,
    __global const int *neighbours,
    __global const int *rows,
    __global const int *targets,
    __global const int *starts,
    __global const int *row_taps,
    __global const float *row_shares,
    __global const int *used,
    const int number,
    const int height,
    const int width,
    const int size,
    const int ring,
    const int nodes,
    const int fresh,
    const int first,
    const int count,
    __global float *residual,
    __global int *opens,
    __global int4 *states,
    __global float *total,
    __global float *cells,
    __global int *kept,
    __global int *flags)
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = first + tid;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int row = COLOUR * (pitch + MARGIN);
    const int across = pitch_of((width + 1) / 2);
    residual += 2 * p * nodes;
    opens += p * (height + 1);
    total += p * ring * row;
    cells += 4 * p * size;
    orient(used[p], own + LANES, shares, firsts, neighbours, rows, targets, starts, row_taps,
           row_shares, area, pitch, nodes, 1, flow + LANES, residual);
    const int needed = reach(residual + nodes, height, pitch, opens);
    if (fresh)
        for (int i = 0; i < ring * row; ++i)
            total[i] = 0.0f;
    for (int r = 1; r <= 4 * ((height + 1) / 2); ++r)
        put(cells + r * across - LANES, (float16)0.0f);
    states[p] = (int4)(needed, 0, 0, 0);
    kept[p] = 0;
    if (p == 0) {
        kept[number] = 0;
        for (int i = 0; i < area; ++i)
            flags[i] = 0;
    }
}

__kernel void advance(
    __global const ushort16 *textures,
    __global const float *residual,
    __global const int *opens,
    __global const float *scale,
    __global const int *used,
    const int number,
    const int height,
    const int width,
    const int size,
    const int ring,
    const int nodes,
    const float hole,
    const int depth,
    const int first,
    const int count,
    __global float *total,
    __global float *cells,
    __global int *places,
    __global float *steps,
    __global int *holes,
    __global int4 *states,
    __global int *flags,
    __global float *band)
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = (first + tid) % number;
    const int top = (first + tid) / number * depth;
    const int bottom = top + depth < height ? top + depth : height;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int row = COLOUR * (pitch + MARGIN);
    __global float *out = band + 3 * p * depth * pitch;
    holes += p * area;
    const int4 before = states[p];
    const int4 at = carry_on(textures + COLOUR * used[p] * area / LANES, height, width, pitch,
        residual + 2 * p * nodes, residual + (2 * p + 1) * nodes, hole, 1.0f / WHITE, scale,
        total + p * ring * row, cells + 4 * p * size, opens + p * (height + 1),
        places + 2 * p * pitch, steps + 7 * p * pitch, holes, before, bottom, 0, depth * pitch,
        out - top * pitch);
    for (int k = before.w; k < at.w; ++k)
        flags[holes[k]] = 1;
    for (int c = 0; c < 3; ++c)
        for (int i = (bottom - top) * pitch; i < depth * pitch; ++i)
            out[c * depth * pitch + i] = 0.0f;
    states[p] = at;
}

__kernel void set_aside(
    __global const int *flags,
    __global const float *wanted,
    const int number,
    const int height,
    const int width,
    const int depth,
    const int first,
    const int count,
    __global float *band,
    __global float *band_wanted,
    __global float *aside,
    __global float *aside_wanted,
    __global int *slots,
    __global int *kept)
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = (first + tid) % (number + 1);
    const int top = (first + tid) / (number + 1) * depth;
    const int bottom = top + depth < height ? top + depth : height;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int apart = depth * pitch;
    __global float *from = p < number ? band + 3 * p * apart : band_wanted;
    __global float *to = p < number ? aside + 3 * p * area : aside_wanted;
    if (p == number)
        for (int c = 0; c < 3; ++c)
            for (int i = 0; i < apart; ++i)
                from[c * apart + i] = top * pitch + i < area ? wanted[c * area + top * pitch + i] : 0.0f;
    int n = kept[p];
    for (int i = top * pitch; i < bottom * pitch; i += LANES) {
        const int16 marks = *(__global const int16u *)(flags + i);
        if (least(-marks) == 0)
            continue;
        for (int j = i; j < i + LANES; ++j)
            if (flags[j]) {
                __global float *at = from + j - top * pitch;
                to[3 * n] = at[0];
                to[3 * n + 1] = at[apart];
                to[3 * n + 2] = at[2 * apart];
                at[0] = 0.0f;
                at[apart] = 0.0f;
                at[2 * apart] = 0.0f;
                if (p == number)
                    slots[j] = n;
                ++n;
            }
    }
    kept[p] = n;
}

__kernel void finish(
    __global const int *holes,
    __global const int *slots,
    __global const float *scale,
    __global const int4 *states,
    const int number,
    const int height,
    const int width,
    const int size,
    const int first,
    const int count,
    __global float *cells,
    __global float *aside,
    __global int *arrived)
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int p = first + tid;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int found = states[p].w;
    cells += 4 * p * size;
    holes += p * area;
    aside += 3 * p * area;
    arrived[p] = found == 0 || fill(cells, (height + 1) / 2, (width + 1) / 2);
    if (arrived[p])
        for (int k = 0; k < found; ++k) {
            const int i = holes[k];
            const float4 colour = scale[i] / WHITE * between(cells, height, width, i / pitch, i % pitch);
            __global float *at = aside + 3 * slots[i];
            at[0] = colour.x;
            at[1] = colour.y;
            at[2] = colour.z;
        }
}
